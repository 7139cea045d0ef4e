"""The display of a result: as text, in a notebook, as an animation, as labelled arrays; `lagjax.plot` draws figures.

_summary     the three-line summary of a trajectory
_notebook    the HTML of a result: its text, and a small picture
_course      a motion interpolated between its outputs
_animation   a motion as a film
_c_source    the equations of a scene in C
_equations_text   the equations of a scene as formulas, which _formula_text writes
_export      a trajectory as an xarray.Dataset or a pandas.DataFrame
"""

from lagjax._show._animation import Animation, make_animation, require_points
from lagjax._show._c_source import write_c
from lagjax._show._course import course_of, courses_of, join_curve, spans_of, wrap_curve
from lagjax._show._equations_text import Equations, write_equations
from lagjax._show._export import change_frame, columns_of, impact_frame, make_dataset, make_frame, spread_prefix
from lagjax._show._notebook import (
    COLORS,
    draw_curves,
    even_places,
    html_cell,
    render_picture,
    simplify_axes,
    trajectory_html,
)
from lagjax._show._summary import canonical_summary, import_package, require_numbers, summary
