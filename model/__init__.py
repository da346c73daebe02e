"""The network of ForeHOI: data, encoders, both stages, training, reconstruction; see README.md."""

import os

# PyTorch's threads meet at a barrier after each operation. Spinning there, they take the time of the very thread that
# they wait for as soon as another program wants a core (DECISIONS D95). Read once, when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
