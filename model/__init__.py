"""The network of ForeHOI: data, encoders, both stages, training, reconstruction; see README.md."""

import os

# PyTorch's threads meet at a barrier after each operation. Spinning there for long, they take the time of the very
# thread that they wait for as soon as another program wants a core; asleep at once, they are slow to wake on a quiet
# machine (DECISIONS D95). Read once, when torch is imported; other OpenMP libraries than GNU's know the policy alone.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")
