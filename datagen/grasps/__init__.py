"""Motions of one hand and one object before anything is drawn: simulated, or recorded and replayed."""
