"""The look of a result: as text, in a notebook, as a film, as labelled arrays; `lagjax.plot` draws the figures.

_summary     the three lines of a trajectory
_notebook    the HTML of a result: its text, and a small picture
_animation   a motion as a film; states between outputs
_export      a trajectory as an xarray.Dataset or a pandas.DataFrame, intervals as a table
"""

from lagjax._display._animation import Animation, animated, as_points, course_of, courses_of
from lagjax._display._export import dataset, frame, intervals
from lagjax._display._notebook import COLORS, cell, of_trajectory
from lagjax._display._summary import summary, times_of_members

__all__ = [
    "COLORS", "Animation", "animated", "as_points", "cell", "course_of", "courses_of", "dataset", "frame", "intervals",
    "of_trajectory", "summary", "times_of_members",
]  # fmt: skip
