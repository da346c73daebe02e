"""How the starter pack was made."""
