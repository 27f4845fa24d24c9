"""Hands for Rerun: into an .rrd file, or to a viewer that is running. Needs the extra ``rerun``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dexkit.errors import ExtraMissing, UsageError
from dexkit.escaping import output_error
from dexkit.hand import Floats
from dexkit.kinematics import quaternions
from dexkit.redaction import redact
from dexkit.staging import Staged
from dexkit.view.drawing import GHOST, Colors
from dexkit.view.forward import Moment

try:
    import rerun as rr
except ImportError as error:
    raise ExtraMissing(
        "--rerun needs the package rerun-sdk", hint="pip install 'dexkit[rerun]'"
    ) from error

__all__ = ["RerunViewer"]


class RerunViewer:
    """A Rerun recording; a file is there when it is whole.

    :param out: an ``.rrd`` file, or the URL of a viewer (``rerun+http://HOST:9876/proxy``).
    :raises UsageError: it cannot be written or reached.
    """

    def __init__(self, out: str) -> None:
        self._stream = rr.RecordingStream("dexkit")
        self._faults: dict[str, list[str]] = {}
        self._staged: Staged | None = None
        try:
            if "://" in out:
                self._stream.connect_grpc(out)
            else:
                self._staged = Staged(Path(os.path.realpath(out)))
                self._stream.save(self._staged.path)
        except (OSError, RuntimeError, ValueError) as error:
            if self._staged is not None:
                self._staged.discard()
            raise UsageError(f"cannot write {redact(out, out)}: {redact(error, out)}") from error
        self._stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def close(self) -> None:
        """Write the buffered data."""
        self._stream.flush()
        self._stream.disconnect()
        if self._staged is not None:
            try:
                self._staged.publish()
            except OSError as error:
                raise output_error(self._staged.target, error) from error
            finally:
                self._staged.discard()

    def show(self, time_ns: int, moments: Sequence[Moment]) -> None:
        """Log a moment on the time line ``time``."""
        self._stream.set_time("time", timestamp=time_ns / 1e9)
        for moment in moments:
            self._figure(moment)
            for field, joints in moment.numbers().items():
                for joint, value in joints.items():
                    self._stream.log(f"{moment.name}/{field}/{joint}", rr.Scalars(value))
            faults = moment.view.faults
            if self._faults.get(moment.name, []) != faults:
                self._faults[moment.name] = faults
                text = "; ".join(faults) or "no fault"
                level = "WARN" if faults else "INFO"
                self._stream.log(f"{moment.name}/faults", rr.TextLog(text, level=level))

    def _figure(self, moment: Moment) -> None:
        drawn, name = moment.drawn, f"scene/{moment.name}"
        self._boxes(f"{name}/bodies", moment.placed(drawn.bodies), moment.sizes, drawn.body_colors)
        if len(drawn.pins):
            pins = moment.placed(drawn.pins)
            self._boxes(f"{name}/joints", pins, moment.pin_sizes, drawn.pin_colors)
        if drawn.ghost is None:
            self._stream.log(f"{name}/command", rr.Clear(recursive=False))
        else:
            color = np.tile(np.array([*GHOST, 70], dtype=np.uint8), (len(drawn.ghost), 1))
            self._boxes(f"{name}/command", moment.placed(drawn.ghost), moment.sizes * 1.04, color)
        if len(drawn.elements):
            frames = np.tile(np.eye(4), (len(drawn.elements), 1, 1))
            frames[:, :3, 3] = drawn.elements
            centers = moment.placed(frames)[:, :3, 3]
            colors = drawn.element_colors
            self._stream.log(f"{name}/pressure", rr.Points3D(centers, radii=0.0045, colors=colors))

    def _boxes(self, name: str, frames: Floats, sizes: Floats, colors: Colors) -> None:
        turns = quaternions(frames)[:, [1, 2, 3, 0]]  # x y z w there
        self._stream.log(
            name,
            rr.Boxes3D(
                centers=frames[:, :3, 3],
                sizes=sizes,
                quaternions=turns,
                colors=colors,
                fill_mode="solid",
            ),
        )
