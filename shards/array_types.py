"""Array annotations: jaxtyping where it is installed, inert names where it is not.

Readers of the dataset need nothing but NumPy, pyarrow and OpenEXR, so `shards`
cannot require jaxtyping. In the test environment it is installed and beartype
checks every shape and dtype below.
"""

__all__ = ["Bool", "Float", "Float32", "Int", "UInt8"]

try:
    from jaxtyping import Bool, Float, Float32, Int, UInt8
except ImportError:

    class _Unchecked:
        """`Float[np.ndarray, "frame 4 4"]` reads the same and means `np.ndarray`."""

        def __class_getitem__(cls, item: tuple[type, str]) -> type:
            return item[0]

    Bool = Float = Float32 = Int = UInt8 = _Unchecked  # type: ignore[assignment]
