"""Every column of the three files of a shard, described once.

`ObjectRow`, `ClipRow` and `FrameRow` are one row of objects.parquet, clips.parquet and
frames.parquet. The Arrow schema, the checks on rows and the README tables (column_tables.py) come from them.
"""

# ruff: noqa: RUF009  (`column` is `dataclasses.field` with metadata: it makes no shared default)

from dataclasses import dataclass

import numpy as np

from shards.array_types import Float, Int, UInt8
from shards.columns import column

__all__ = [
    "CONVENTIONS",
    "ROW_TYPES",
    "SCHEMA_VERSION",
    "ClipRow",
    "FrameRow",
    "ObjectRow",
]

SCHEMA_VERSION = "1.0.0"

CONVENTIONS = (
    "T_b_from_a: x_b = T_b_from_a @ x_a. World: Z up, metres, seconds, radians. "
    "Camera: OpenCV axes (x right, y down, z forward), K in pixels, image corner (0, 0), "
    "first pixel centre (0.5, 0.5). Depth: z in the camera frame, metres, 0 where nothing is hit. "
    "Boxes: x0 y0 x1 y1 in pixel edges, -1 four times when empty. Masks: 8-bit PNG bits 1 hand visible, "
    "2 object visible, 4 hand amodal, 8 object amodal, 16 arm visible, 32 arm amodal. "
    "Object canonical frame: the mesh's own axes, bounding-box centre at 0, longest side 1. "
    "Hand: MANO joint order, axis-angle."
)


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectRow:
    """One object of a shard, once, however many motions use it."""

    object_uid: str = column(
        "string",
        meaning="Identity of the object across the data set. Splits hash what comes before an '@' in the last part "
        "of its path: variants of one object (other size, mirrored) stay together.",
    )
    name: str = column("string", meaning="Short human name.")
    source: str = column("string", meaning="Collection the object comes from.")
    licence: str = column(
        "string",
        meaning="SPDX expression of the object's licence; with AND where a mesh derives from another work.",
    )
    author: str = column("string", meaning="Who to credit.")
    url: str = column("string", meaning="Where the object was published.")
    mesh_glb: bytes | None = column(
        "binary",
        nullable=True,
        frame="obj",
        meaning="Textured mesh as binary glTF, metres. Null where the licence forbids copies.",
    )
    mesh_sha256: str = column(
        "string", meaning="SHA-256 (hex) of the binary glTF, also where its bytes are left out."
    )
    object_scale_m: float = column(
        "float64", unit="m", meaning="Longest side of the bounding box of the drawn and the watertight mesh."
    )
    catalogue_scale: float = column(
        "float64", meaning="Factor applied to the source's own metric size; 1 where it was trusted."
    )
    T_objmesh_from_canonical: Float[np.ndarray, "4 4"] = column(
        "float64",
        4,
        4,
        unit="m",
        frame="obj <- canonical",
        meaning="x_obj = T @ x_canonical: object_scale_m on the diagonal, "
        "bounding-box centre in the last column.",
    )
    occupancy_64: UInt8[np.ndarray, "voxel 3"] = column(
        "uint8",
        "voxel",
        3,
        unit="voxel",
        frame="canonical",
        meaning="(i, j, k) along (x, y, z) of the voxels that the surface passes through, 0..63, sorted, unique; "
        "voxel i spans [i/64 - 0.5, (i+1)/64 - 0.5].",
    )
    surface_points: Float[np.ndarray, "surface 3"] = column(
        "float32",
        "surface",
        3,
        unit="canonical",
        frame="canonical",
        meaning="Points spread evenly over the surface.",
    )
    surface_normals: Float[np.ndarray, "surface 3"] = column(
        "float32", "surface", 3, frame="canonical", meaning="Outward unit normals of surface_points."
    )
    surface_colors: UInt8[np.ndarray, "surface 3"] = column(
        "uint8",
        "surface",
        3,
        unit="sRGB",
        meaning="Colour (RGB, no shading) of surface_points: base colour, or emission where that is brighter.",
    )
    sdf_points: Float[np.ndarray, "sample 3"] = column(
        "float32",
        "sample",
        3,
        unit="canonical",
        frame="canonical",
        meaning="Where the signed distance is sampled.",
    )
    sdf_values: Float[np.ndarray, " sample"] = column(
        "float32", "sample", unit="canonical", frame="canonical", meaning="Signed distance, negative inside."
    )
    texture_resolution_px: int = column(
        "int32", unit="px", meaning="Longest side of the largest base-colour image; 0 without one."
    )
    color_detail: float = column("float32", meaning="Colour detail of the texture; larger is richer.")
    appearance: str = column(
        "string",
        choices=("original", "generated"),
        meaning="Whether colours and textures are the object's own, or generated for a mesh that has none.",
    )
    registration_residual: float = column(
        "float32",
        allow_nan=True,
        meaning="Where a textured original was matched onto the mesh of a recorded motion: 95th percentile of "
        "their distance over the bounding box's diagonal; NaN otherwise.",
    )
    watertight_source: bool = column("bool", meaning="Whether the source mesh was closed before any repair.")


@dataclass(frozen=True, kw_only=True, eq=False)
class ClipRow:
    """One clip: one motion seen by one camera."""

    clip_id: str = column(
        "string", meaning="Identity of the clip; row group i of frames.parquet is clip row i."
    )
    motion_id: str = column(
        "string", meaning="Identity of the motion; its clips share everything but the camera."
    )
    motion_index: int = column("int64", meaning="Number of the motion in the plan.")
    camera_index: int = column("int32", meaning="Number of the camera within the motion.")
    object_uid: str = column("string", meaning="Row of objects.parquet.")
    split: str = column(
        "string", choices=("train", "val", "test"), meaning="By hash of the object, never by clip."
    )
    dataset_seed: int = column("int64", meaning="First entropy word of every random stream of the data set.")
    n_frames: int = column("int32", meaning="Rows of this clip in frames.parquet.")
    fps: float = column("float64", unit="1/s", meaning="Frames per second.")
    image_width: int = column("int32", unit="px", meaning="Image width.")
    image_height: int = column("int32", unit="px", meaning="Image height.")
    K: Float[np.ndarray, "3 3"] = column(
        "float64", 3, 3, unit="px", frame="image <- cam", meaning="Pinhole matrix."
    )
    camera_kind: str = column(
        "string", meaning="Kind of camera path: orbit, arc, handheld, dolly, egocentric."
    )

    hand_model: str = column("string", meaning="Hand model in MANO layout: openhand or mano.")
    hand_stands_in_for: str = column(
        "string",
        meaning="Hand model the motion was recorded with, where hand_model is only an approximate stand-in "
        "for it (then contacts are approximate too); empty otherwise.",
    )
    hand_side: str = column("string", choices=("right", "left"), meaning="Which hand.")
    flat_hand_mean: bool = column(
        "bool", meaning="True: hand_pose is the full rotation; false: an offset from the model's mean pose."
    )
    betas: Float[np.ndarray, " beta"] = column(
        "float32", "beta", meaning="Shape coefficients of the hand model."
    )
    skin_model: str = column(
        "string", meaning="Skin texture model: open, or html with its variant (html model_sr)."
    )
    skin_coefficients: Float[np.ndarray, " coefficient"] = column(
        "float32", "coefficient", meaning="Coefficients of the skin texture model."
    )
    skin_roughness: float = column("float32", meaning="Surface roughness of the skin, 0..1.")
    skin_subsurface: float = column("float32", meaning="Weight of subsurface scattering, 0..1.")
    skin_bump: float = column("float32", meaning="Strength of fine skin relief, 0..1.")
    nail_gloss: float = column("float32", meaning="Gloss of the nails, 0..1.")
    has_sleeve: bool = column("bool", meaning="Whether a sleeve covers the forearm.")
    sleeve_color_rgb: Float[np.ndarray, "3"] = column("float32", 3, unit="linear", meaning="Sleeve colour.")

    grasp_source: str = column("string", meaning="Where the motion comes from: synthesised or graspxl.")
    grasp_sequence_id: str = column("string", meaning="Identity of the grasp sequence in its source.")
    grasp_licence: str = column(
        "string", meaning="SPDX licence of a recorded motion, which its poses keep; empty when simulated."
    )
    grasp_frame: int = column("int32", meaning="First frame in which the closed hand carries the object.")
    rise_m: float = column(
        "float32", unit="m", allow_nan=True, meaning="Object height at the end minus start."
    )
    center_distance_m: float = column(
        "float32", unit="m", allow_nan=True, meaning="Hand centre to object centre at the end."
    )
    max_penetration_m: float = column(
        "float32",
        unit="m",
        allow_nan=True,
        meaning="Deepest hand vertex inside the object, over sampled instants: of the whole motion when simulated, "
        "every fifth frame from the grasp on when recorded.",
    )
    digits_in_contact: int = column("int32", meaning="Digits that touch at the end, 0..5; -1 not measured.")
    slip_lift_m: float = column(
        "float32", unit="m", allow_nan=True, meaning="Slip in the hand during the lift."
    )
    slip_manipulation_m: float = column(
        "float32", unit="m", allow_nan=True, meaning="Slip during manipulation; NaN where there is none."
    )
    digit_distance_m: Float[np.ndarray, "5"] = column(
        "float32",
        5,
        unit="m",
        meaning="Smallest signed distance of thumb, index, middle, ring and pinky to the object, median while "
        "it is carried; negative inside.",
    )
    grasp_attempts: int = column(
        "int32", meaning="Simulations until this grasp was kept, itself included; 0: recorded."
    )

    light_position_world: Float[np.ndarray, "light 3"] = column(
        "float32", "light", 3, unit="m", frame="world", meaning="Centres of the area lights."
    )
    light_target_world: Float[np.ndarray, "light 3"] = column(
        "float32", "light", 3, unit="m", frame="world", meaning="Points the lights face."
    )
    light_power_w: Float[np.ndarray, " light"] = column(
        "float32", "light", unit="W", meaning="Radiant power."
    )
    light_size_m: Float[np.ndarray, " light"] = column(
        "float32", "light", unit="m", meaning="Side of the square."
    )
    light_color_rgb: Float[np.ndarray, "light 3"] = column(
        "float32", "light", 3, unit="linear", meaning="Colour of the lights."
    )
    hdri: str = column("string", meaning="Name of the environment image.")
    hdri_rotation_rad: float = column("float32", unit="rad", meaning="Turn of the environment about world Z.")
    hdri_strength: float = column("float32", meaning="Factor on the environment's radiance.")
    has_table: bool = column("bool", meaning="Whether a table is in the scene.")
    table_top_z_m: float = column(
        "float32",
        unit="m",
        frame="world",
        allow_nan=True,
        meaning="Height of the table top; NaN without a table.",
    )
    table_material: str = column("string", meaning="wood, stone, cloth, laminate; empty without a table.")

    object_visible_fraction_min: float = column("float32", meaning="Smallest over the frames.")
    object_visible_fraction_mean: float = column("float32", meaning="Mean over the frames.")
    hand_visible_fraction_min: float = column("float32", meaning="Smallest over the frames.")
    hand_visible_fraction_mean: float = column("float32", meaning="Mean over the frames.")
    object_drift_px: float = column(
        "float32",
        unit="px",
        meaning="Largest distance of the projected object centre from its mean over the clip.",
    )
    min_margin_px: float = column(
        "float32",
        unit="px",
        meaning="Smallest distance of a projected hand or object vertex to the image border.",
    )

    render_engine: str = column("string", meaning="Renderer, for example Cycles.")
    render_engine_version: str = column("string", meaning="Version of the renderer, for example bpy 4.5.15.")
    render_device: str = column("string", meaning="Device that was really used, for example CPU.")
    render_samples: int = column("int32", meaning="Samples per pixel.")
    render_denoiser: str = column("string", meaning="Denoiser, or none.")
    render_view_transform: str = column("string", meaning="Tone curve from linear light to the stored image.")
    render_exposure_ev: float = column("float32", unit="EV", meaning="Exposure in stops.")
    render_seconds: float = column(
        "float32", unit="s", meaning="Time spent rendering the clip's images; a measurement."
    )
    rgb_codec: str = column("string", choices=("png", "jpeg", "webp"), meaning="Encoding of frames.rgb.")


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameRow:
    """One frame of one clip."""

    clip_id: str = column("string", meaning="Clip this frame belongs to.")
    frame_index: int = column("int32", meaning="0, 1, 2, ... within the clip.")
    time_s: float = column("float64", unit="s", meaning="frame_index / fps.")
    T_cam_from_world: Float[np.ndarray, "4 4"] = column(
        "float64", 4, 4, unit="m", frame="cam <- world", meaning="Camera pose, rigid."
    )
    T_world_from_obj: Float[np.ndarray, "4 4"] = column(
        "float64",
        4,
        4,
        unit="m",
        frame="world <- obj",
        meaning="Object pose, rigid; obj is the mesh's own frame.",
    )
    hand_orientation_world: Float[np.ndarray, "3"] = column(
        "float32",
        3,
        unit="rad",
        frame="world",
        meaning="Wrist rotation, axis-angle, about the rest wrist joint.",
    )
    hand_pose: Float[np.ndarray, "45"] = column(
        "float32", 45, unit="rad", frame="parent joint", meaning="15 joint rotations, axis-angle, MANO order."
    )
    hand_translation_world: Float[np.ndarray, "3"] = column(
        "float32", 3, unit="m", frame="world", meaning="Added last (smplx transl)."
    )
    joints_world: Float[np.ndarray, "21 3"] = column(
        "float32",
        21,
        3,
        unit="m",
        frame="world",
        meaning="16 MANO joints, then tips of thumb, index, middle, ring, pinky.",
    )
    joints_px: Float[np.ndarray, "21 2"] = column(
        "float32",
        21,
        2,
        unit="px",
        frame="image",
        allow_nan=True,
        meaning="Projected joints; NaN behind the camera.",
    )
    hand_box_visible_px: Int[np.ndarray, "4"] = column(
        "int32",
        4,
        unit="px",
        frame="image",
        meaning="Tight box of the visible hand: x0 y0 x1 y1; -1 when empty.",
    )
    hand_box_amodal_px: Int[np.ndarray, "4"] = column(
        "int32", 4, unit="px", frame="image", meaning="Tight box of the amodal hand mask."
    )
    object_box_visible_px: Int[np.ndarray, "4"] = column(
        "int32", 4, unit="px", frame="image", meaning="Tight box of the visible object."
    )
    object_box_amodal_px: Int[np.ndarray, "4"] = column(
        "int32", 4, unit="px", frame="image", meaning="Tight box of the amodal object mask."
    )
    hand_pixels_visible: int = column("int32", unit="px", meaning="Pixels of the visible hand (without arm).")
    hand_pixels_amodal: int = column("int32", unit="px", meaning="Pixels of the amodal hand.")
    object_pixels_visible: int = column("int32", unit="px", meaning="Pixels of the visible object.")
    object_pixels_amodal: int = column("int32", unit="px", meaning="Pixels of the amodal object.")
    hand_visible_fraction: float = column(
        "float32", meaning="Visible / amodal pixels; 0 when there are none."
    )
    object_visible_fraction: float = column(
        "float32", meaning="Visible / amodal pixels; 0 when there are none."
    )
    contact_force_n: Float[np.ndarray, "5"] = column(
        "float32",
        5,
        unit="N",
        allow_nan=True,
        meaning="Normal force per digit: thumb, index, middle, ring, pinky; NaN where a motion was recorded "
        "without forces.",
    )
    hand_object_distance_m: float = column(
        "float32",
        unit="m",
        meaning="Smallest signed distance of hand vertices to the object's surface, negative inside.",
    )
    rgb: bytes = column("binary", meaning="Encoded colour image, sRGB; the codec is clips.rgb_codec.")
    masks: bytes = column(
        "binary",
        meaning="8-bit gray PNG of bits: 1 hand visible, 2 object visible, 4 hand amodal, 8 object amodal, "
        "16 arm visible, 32 arm amodal (arm: forearm and sleeve).",
    )
    geometry: bytes = column(
        "binary",
        frame="cam",
        meaning="OpenEXR: Z depth of the scene, object.Z depth of the object alone "
        "(both float32 metres, 0 nothing), N.X N.Y N.Z unit normal of the visible surface (half, 0 nothing).",
    )


ROW_TYPES = {"objects": ObjectRow, "clips": ClipRow, "frames": FrameRow}
