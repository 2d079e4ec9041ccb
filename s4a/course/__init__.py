"""The course (notebooks/): self-checking exercises, quizzes, sliders and diagrams.

It also exports the functions on plain arrays that lessons use: charts, meshes as arrays, areas and
normals, closest points, and KnnSearch.
"""

from s4a.course import diagrams as diagrams
from s4a.course.exercises import check as check
from s4a.course.exercises import judge as judge
from s4a.course.exercises import quiz as quiz
from s4a.course.sliders import slide as slide
from s4a.course.sliders import takeaway as takeaway
from s4a.geometry.closest import closest_point as closest_point
from s4a.geometry.mesh import as_arrays as as_arrays
from s4a.geometry.mesh import as_dataset as as_dataset
from s4a.geometry.mesh import triangle_areas as triangle_areas
from s4a.geometry.mesh import vertex_areas as vertex_areas
from s4a.geometry.mesh import vertex_normals as vertex_normals
from s4a.method.nearest import nearest_rows as nearest_rows
from s4a.show import charts as charts
from s4a.show.draw import label_colors as label_colors
from s4a.show.draw import position_colors as position_colors
