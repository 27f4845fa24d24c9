"""Which plots show a result: named by a requirement in the catalogue, or by its check.

:mod:`dexkit.conformance.report.result_plots` draws them. This module only names them, so that
catalogue, checks and result files do not depend on the drawing code.
"""

from __future__ import annotations

from enum import Enum

from dexkit.errors import UsageError

__all__ = ["Plot", "PlotKind"]


class PlotKind(str, Enum):
    """Kinds of plots; "the place" is the first place in the recording named by the check."""

    ENDPOINTS = "endpoints"
    """Table of the endpoints that a client needs, and of those that discovery found."""
    POSITION = "position"
    """Command and state of the joints about the place, and what a modelled operator wants."""
    BOTH_SIDES = "both-sides"
    """Positions of both hands while only the other one is commanded."""
    STEPS = "steps"
    """All steps laid over each other, as the distance to the target."""
    SAMPLES = "samples"
    """The single samples of a joint's position about the place."""
    RATE = "rate"
    """Rate of the state in windows of half a second."""
    INTERVAL_HISTOGRAM = "interval-histogram"
    """Histogram of the intervals between states."""
    INTERVALS = "intervals"
    """Each interval between states over the whole run."""
    GAP = "gap"
    """Each interval between states about the place."""
    COMMAND_INTERVALS = "command-intervals"
    """Each interval between commands over the whole run."""
    TORQUE = "torque"
    """``tau_est`` of the joints about the place."""
    TORQUE_BY_POSITION = "torque-by-position"
    """``tau_est`` over q, all states and those at the place."""
    PRESSURE = "pressure"
    """Change of pressure since rest, summed over each sensor packet, about the place."""
    MEMBER = "member"
    """A member of the state message about the place; :attr:`Plot.member` names it."""
    DESCRIPTORS = "descriptors"
    """USB: the device's descriptors."""
    BYTES = "bytes"
    """USB: bytes of the transfer at a place without an end."""
    ANSWERS = "answers"
    """USB: joint positions in the answers about a place with an end."""
    LATENCY = "latency"
    """USB: histogram of the time from a command to its answer."""

    def __str__(self) -> str:
        return self.value


class Plot(str):
    """One plot of a result: the text ``position`` or ``member:imu_state.quaternion[0]``.

    :param member: of :attr:`PlotKind.MEMBER`: ``dq``, ``ddq``, ``tau_est`` or ``mode`` of the
        result's joint, ``length`` of the motor sequence, or the path of a member of the state
        message, whose last index may be an element of an array.
    """

    __slots__ = ()

    def __new__(cls, kind: PlotKind, member: str = "") -> Plot:
        """The plot of that kind."""
        return super().__new__(cls, f"{kind}:{member}" if member else str(kind))

    @property
    def kind(self) -> PlotKind:
        """What is drawn."""
        return PlotKind(self.partition(":")[0])

    @property
    def member(self) -> str:
        """The member of the state message; empty for another kind."""
        return self.partition(":")[2]

    @classmethod
    def parse(cls, text: str) -> Plot:
        """The plot of that name.

        :raises UsageError: there is none, or a member is missing or too many.
        """
        name, _, member = text.partition(":")
        if name not in {str(kind) for kind in PlotKind}:
            raise UsageError(f"no plot {text!r}", hint=f"plots: {', '.join(map(str, PlotKind))}")
        if (PlotKind(name) is PlotKind.MEMBER) is not bool(member):
            raise UsageError(f"a plot is like 'position' or 'member:dq', not {text!r}")
        return cls(PlotKind(name), member)

    @classmethod
    def of_member(cls, path: str) -> Plot:
        """A plot of that member of the state."""
        return cls(PlotKind.MEMBER, path)
