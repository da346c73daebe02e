"""What the network is conditioned on: image and hand features on one token grid (paper, section 3.1)."""
