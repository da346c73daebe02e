"""Child processes that report by events, and seconds per phase."""
