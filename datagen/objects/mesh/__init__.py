"""The drawn mesh of an object, and what is measured on it or done to it."""
