"""What a campaign has done so far, kept in a file, so that it can be continued."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dexkit.documents import write_file
from dexkit.errors import UsageError
from tools.campaign.case import Finding

__all__ = ["Progress", "State"]

_VERSION = 1


@dataclass
class Progress:
    """Of one case.

    :param batches: numbers below this have been given out.
    :param again: batches that were given out and did not come to an end.
    :param seconds: of a worker's time.
    """

    batches: int = 0
    units: int = 0
    seconds: float = 0.0
    skipped: str = ""
    failed: str = ""
    notes: list[str] = field(default_factory=list)
    again: list[int] = field(default_factory=list)


@dataclass
class State:
    """Of all cases.

    :param folder: where it is kept, with the findings.
    """

    folder: Path
    seed: str
    cases: dict[str, Progress] = field(default_factory=dict)
    findings: dict[str, Finding] = field(default_factory=dict)
    times: dict[str, int] = field(default_factory=dict)
    wall: float = 0.0

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder / "state.json"

    def progress_of(self, name: str) -> Progress:
        """Progress of a case."""
        return self.cases.setdefault(name, Progress())

    def add(self, finding: Finding) -> bool:
        """Keep a finding, with its input; whether it is a new one."""
        new = finding.id not in self.findings
        self.times[finding.id] = self.times.get(finding.id, 0) + 1
        if new:
            self.findings[finding.id] = finding
            folder = self.folder / "findings"
            folder.mkdir(parents=True, exist_ok=True)
            text = json.dumps({**finding.as_dict(), "repeat": self.command(finding)}, indent=1)
            (folder / f"{finding.id}.json").write_text(text + "\n")
            if finding.data:
                (folder / f"{finding.id}.bin").write_bytes(bytes.fromhex(finding.data))
        return new

    def command(self, finding: Finding) -> str:
        """What repeats it."""
        return f"python -m tools.campaign --repeat {self.folder}/findings/{finding.id}.json"

    def save(self) -> None:
        """Write the file, in one step."""
        self.folder.mkdir(parents=True, exist_ok=True)
        content: dict[str, Any] = {
            "version": _VERSION,
            "seed": self.seed,
            "wall": self.wall,
            "cases": {name: vars(p) for name, p in self.cases.items()},
            "findings": {name: f.as_dict() for name, f in self.findings.items()},
            "times": self.times,
        }
        write_file(self.path, json.dumps(content, indent=1) + "\n")

    @classmethod
    def load(cls, folder: Path, seed: str | None, *, fresh: bool) -> State:
        """What is kept in ``folder``, or a new one.

        :raises UsageError: it is of another seed, or cannot be read.
        """
        path = folder / "state.json"
        if fresh or not path.exists():
            return cls(folder, seed or "1")
        try:
            content = json.loads(path.read_text())
            if content["version"] != _VERSION:
                raise ValueError(f"version {content['version']}")
            state = cls(
                folder,
                content["seed"],
                {name: Progress(**p) for name, p in content["cases"].items()},
                {name: Finding(**f) for name, f in content["findings"].items()},
                content["times"],
                content["wall"],
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UsageError(
                f"{path} cannot be read: {error}", hint="--fresh begins anew"
            ) from error
        if seed is not None and seed != state.seed:
            raise UsageError(
                f"the campaign in {folder} has seed {state.seed}, not {seed}",
                hint="--fresh begins anew, --out names another folder",
            )
        return state
