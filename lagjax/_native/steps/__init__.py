"""A step: its size, its end on constraints, and the first event, knot or border in it.

_roots              the search along a step: the zeros of a polynomial
_projection         the way back to the constraints;  _rank_drops: where these become dependent
_step               step control
_run_records        the outputs, and the record of steps
_watch              numbers that are followed against a level, and what is remembered of each
_border_control     the action of borders: a step ends at the first one, at one of the _knots, or before one of the
                    _narrow_features;  _border_crossing: the piece beyond;  _border_kicks: the velocities there
_saltation          the jump of derivatives at a border, and at a knot of samples
_retraction         the way back onto a border, and its derivatives
_events             the action of guards, to stop the motion or to note
"""
