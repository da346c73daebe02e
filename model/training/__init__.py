"""The trainer and what it needs; it knows no network."""
