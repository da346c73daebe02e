"""glTF 2.0: container, compressed primitives, materials, scenes."""
