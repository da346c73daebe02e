"""What is trained, from one YAML file."""
