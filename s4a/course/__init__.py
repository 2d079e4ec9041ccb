"""The course (notebooks/): self-checking exercises, quizzes, sliders and diagrams.

It also exports the functions on plain arrays that lessons use: charts, meshes as arrays, areas and
normals, closest points, and KnnSearch.
"""

from s4a.course import diagrams
from s4a.course.exercises import check, judge, quiz
from s4a.course.sliders import slide, takeaway
from s4a.geometry.closest import closest_point
from s4a.geometry.mesh import as_arrays, as_dataset, triangle_areas, vertex_areas, vertex_normals
from s4a.method.nearest import nearest_rows
from s4a.show import charts
from s4a.show.draw import label_colors, position_colors

__all__ = [
    "as_arrays",
    "as_dataset",
    "charts",
    "check",
    "closest_point",
    "diagrams",
    "judge",
    "label_colors",
    "nearest_rows",
    "position_colors",
    "quiz",
    "slide",
    "takeaway",
    "triangle_areas",
    "vertex_areas",
    "vertex_normals",
]
