"""The variables that this extension adds to the table of :mod:`s4a.schema`."""

from s4a.schema import INPUT, INPUT2, ONE

# fmt: off
ROWS: dict[str, tuple[str, str, str]] = {
    # several structures of each subject
    "structure_status": ("shape structure", ONE,
        "ok, repaired, doubtful or excluded; missing where a subject has none"),
    "structure_of_vertex": ("vertex", ONE, "structure that the vertex is of"),
    "pose_rotation": ("shape structure xyz", "rad",
        "turn of the structure in the whole, a vector around its centroid"),
    "pose_translation": ("shape structure xyz", INPUT,
        "shift of the structure's centroid in the whole"),
    "pose_size": ("shape structure", INPUT,
        "root mean square over its area of what both displace"),
    "within_displacement": ("shape vertex xyz", INPUT,
        "displacement of the structure's mean shape, its pose taken out"),
    "level_variance": ("structure level", INPUT2,
        "variance of poses (between) and of shapes (within), mean square over the area of all"),
    "level_share": ("structure level", ONE, "its share of the variance"),
    "between_share": ("component", ONE, "share of the joint component that is of poses"),
    "pose_shape_rv": ("", ONE, "RV coefficient of poses and shapes"),
    "pose_shape_p": ("", ONE, "p value of the permutation test of that coefficient"),
}
