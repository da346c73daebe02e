"""Files that users hand in: their text, and the files that they name."""
