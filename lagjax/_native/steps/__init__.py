"""A step: its size, its projection onto constraints, and the first event, knot or border in it.

_roots              the zeros of a polynomial over a step
_projection         the projection onto constraints;  _rank_drops: steps near dependent constraints
_step               step control
_run_records        the outputs, and the record of steps
_watch              numbers that are compared with a level along a step, and what is remembered of each
_border_control     the end of a step at the first border, at one of the _knots, or before one of the
                    _narrow_features;  _border_crossing: the next piece;  _border_kicks: the velocities there
_saltation          the jump of derivatives at a border, and at a knot of samples
_retraction         the projection onto a border along which the motion slides, and its derivatives
_events             the sign changes of guards, which stop the motion or are recorded
"""
