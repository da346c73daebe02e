"""The two-stage flow-matching network: training and reconstruction; see README.md."""
