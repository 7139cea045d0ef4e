"""Narrow features (`_program._features`): a step ends before the series could miss one."""

import itertools
import math

from lagjax._native.code import _constants as limits
from lagjax._native.code._frame import Frame
from lagjax._native.code._ir import Value
from lagjax._native.series._taylor import TaylorSeries, integer
from lagjax._native.steps._roots import Roots
from lagjax._native.steps._watch import StepEnd
from lagjax._program import BELOW, BESIDE, FALLS, GROWS, UP_TO, Feature


class NarrowFeatures:
    """The search for narrow `features`, whose arguments are followed after the switching numbers."""

    def __init__(self, motion: TaylorSeries, roots: Roots, features: tuple[Feature, ...]):
        self.motion, self.roots, self.features = motion, roots, features

    def end_step_at_feature(self, frame: Frame, degree: Value, h: Value) -> None:
        """End the step before the first of all features."""
        frame["next_approach"], first = 0.0, 0
        for feature, row in itertools.groupby(self.features):  # which shares its code: as of a chain's bonds
            end = first + len(list(row))
            with frame.code.loop(integer(frame.code, end), start=first) as i:
                self._limit_step(frame, i + self.motion.pieces, feature, degree, h)
            first = end
        frame["approach"] = frame["next_approach"]

    def _limit_step(self, frame: Frame, j: Value, feature: Feature, degree: Value, h: Value) -> None:
        """End the step where argument j of a feature has come as near as one step may bring it."""
        code = frame.code
        moves, last = self._argument_change(frame, j, degree, h)
        rise = code.lanes_of(code.as_double(degree)) * (limits.RISE / feature.scale)
        near = ~((moves < rise) & (last < limits.ARGUMENT))
        if feature.kind == FALLS:
            size = abs(self.motion.followed_value(frame, j))
            # The base of the power may fall by this in a step of the least order.
            fall = max(math.exp(-limits.RISE * (limits.LEAST_ORDER - 1) / feature.scale), limits.LARGEST_FALL)
            near = ~(moves < (1.0 - fall) * size)
        if feature.kind in (UP_TO, GROWS):  # which change by more than their argument does
            near = frame.constant(0.0) <= 0.0
        with code.only_if(code.any_lane(near)):
            self._find_feature(frame, j, feature, degree, h)

    def _argument_change(self, frame: Frame, j: Value, degree: Value, h: Value) -> tuple[Value, Value]:
        """A bound Σ |cₖ|, k > 0, of the change of argument j over the step, and the size of its last terms."""
        code, size, sum = frame.code, abs(h), frame.constant(0.0)

        def coefficient(k: Value) -> Value:
            return abs(self.motion.followed_coefficient(frame, j, k))

        for i in range(3):
            sum = (sum + coefficient(degree - i)) * size
        sum, last = code.variable(sum), code.variable(sum)
        with code.loop(degree, start=3) as i:
            sum.value = (sum.value + coefficient(degree - i)) * size
            last.value = last.value * size
        return sum.value, last.value

    def _find_feature(self, frame: Frame, j: Value, feature: Feature, degree: Value, h: Value) -> None:
        """End the step at the root of the level α + β u, u being argument j; `start` is its initial value."""
        code, kind, u = frame.code, feature.kind, self.motion.followed_value(frame, j)
        matters, slope, start, of_size, absolute = self._approach_level(frame, j, feature, degree, h)
        if kind in (BELOW, BESIDE):
            far = start > limits.FAR
            start = code.select(far, (1.0 - limits.LARGEST_FALL) * start, start)
            of_size = code.select(far, limits.ARGUMENT * limits.LARGEST_FALL, of_size)
        self.roots.polynomial(frame, j, degree, h, slope, u - start / slope)
        if kind == FALLS:  # one that rises is told by fewer terms
            self.roots.store_bounds(frame, degree)
            rises = frame["falls"] < start
            size = start + frame["rises"]
            matters = matters & ~(rises & (self.roots.last_terms(frame, degree) < limits.ARGUMENT * size))
        self.roots.shorten_to(frame, degree, of_size, absolute)
        frame.call(self.roots.first_root, degree)
        root = self.roots.step_fraction(frame, 2.0)
        if kind in (UP_TO, FALLS):
            matters, root = self._approach(frame, kind, h, matters, root)
        sooner = matters & (root > 0.0) & (root < frame["nearest"]) & code.compare("!=", h, 0.0)
        frame.assign(sooner, nearest=root, crossed=StepEnd.NOTHING)

    def _approach_level(self, frame: Frame, j: Value, feature: Feature, degree: Value, h: Value) -> tuple:
        """The level α + β u of a feature, whose zero is as near as a step may come.

        Returns whether the feature matters, β, the level, and the relative and absolute accuracy that it needs.
        """
        code, kind, scale = frame.code, feature.kind, feature.scale
        u = self.motion.followed_value(frame, j)
        rise = code.lanes_of(code.as_double(degree)) * limits.RISE
        side = code.select(u < 0.0, -1.0, 1.0)
        matters, slope = code.compare("!=", u, 0.0), side
        of_size, absolute = frame.constant(0.0), frame.constant(limits.ARGUMENT)
        if kind == UP_TO:
            start, of_size, absolute = side * u, frame.constant(limits.ABRUPT), frame.constant(0.0)
        elif kind == FALLS:
            fall = code.maximum(code.library("exp", rise * (-1.0 / scale)), frame.constant(limits.LARGEST_FALL))
            start, absolute = side * (u - fall * u), limits.ARGUMENT * (fall * (side * u))
        elif kind == GROWS:
            faint = frame.constant(math.exp(-limits.FAINT / scale))
            level = code.maximum(code.library("exp", rise * (1.0 / scale)) * u, faint)
            matters, slope, start = level > 0.0, frame.constant(-1.0), level - u
            absolute = limits.ARGUMENT * level
        else:
            slope = frame.constant(-scale) if kind == BELOW else scale * side
            level = code.maximum(rise - slope * u, -limits.FAINT)
            matters = level < (float("inf") if kind == BELOW else 0.0)
            start = level + slope * u
            if kind == BELOW:  # from above it first reaches arguments that have a series
                above, falls = u * scale - limits.BEYOND, self.motion.followed_coefficient(frame, j, 1) * h < 0.0
                high = (above > 0.0) | ((u * scale > limits.STEEP) & falls)
                slope = code.select(high, scale, slope)
                start = code.select(high, code.maximum(above, rise), start)
        return matters, slope, start, of_size, absolute

    def _approach(self, frame: Frame, kind: int, h: Value, matters: Value, root: Value) -> tuple[Value, Value]:
        """Shorten steps geometrically towards a point without series, then step over it if a series exists beyond."""
        code, found = frame.code, self.roots.is_found(frame)
        way, whole = frame["root"] * frame["part"], abs(h)
        nearby = (limits.NEARBY if kind == UP_TO else limits.NARROWEST) * code.maximum(whole, frame["approach"])
        instant = code.lanes_of(limits.INSTANT * frame["smallest"])  # what is as near, time does not tell from here
        nearby = code.maximum(nearby, instant) if kind == UP_TO else nearby
        far = way * whole > nearby
        frame.assign(matters & far & found, next_approach=code.maximum(whole, frame["approach"]))
        if kind == FALLS:
            return matters & (far | ~found), root
        beyond = code.maximum(frame.constant(limits.NEARBY), 2.0 * instant / whole)
        past = code.select(far, way * limits.SHORT_OF, way * limits.PAST + beyond)
        return matters, code.select(found, past, root)
