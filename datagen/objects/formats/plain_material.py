"""Materials of formats that know none."""

from datagen.objects.mesh.object_mesh import Material

__all__ = ["PLAIN", "WHITE"]

PLAIN = Material(name="plain", base_color_rgba=(0.6, 0.6, 0.6, 1.0))
WHITE = Material(name="white", base_color_rgba=(1.0, 1.0, 1.0, 1.0))  # below colours or a texture
