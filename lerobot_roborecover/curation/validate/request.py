"""What is asked of a validation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.curation.validate.validation import ValidationRule
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.workers.backend import LOCAL, Backend


@dataclass(frozen=True)
class ValidationRequest:
    """What to validate and how."""

    dataset: Path
    """Folder of the scenario dataset."""
    trials_folder: Path
    """As `screen` left it: one folder a policy."""
    out: Path
    """Folder of the new dataset; an earlier validation's that nothing was made of is replaced."""
    candidates: Sequence[Path] = ()
    """Candidate datasets that the scenarios were made from: original poses and frames."""
    rule: ValidationRule = field(default_factory=ValidationRule)
    env: Sequence[str] = ()
    """`name=value` options of the recovery env type: as the originals were rendered."""
    rejects: Mapping[str, str] = field(default_factory=dict)
    """Reasons by id of scenarios that a person rejects."""
    accepts: Sequence[str] = ()
    """Ids whose rejection a person takes back."""
    by: str = "a person"
    """Who looked; goes into the decisions."""
    workers: int = 0
    """Processes that replay; 0 takes one, or all CPUs of a cluster."""
    workplace: Backend = LOCAL
    """Where they are."""
    limit_s: float = 900.0
    """Longest that all replays of one scenario may take."""
    work: Path | None = None
    """Working folder; None takes `OUT.replays`."""

    @property
    def folder(self) -> Path:
        """The working folder."""
        return self.work or self.out.with_name(f"{self.out.name}.replays")

    def sheet(self, scenario_id: str) -> Path:
        """A scenario's contact sheet."""
        return self.folder / "sheets" / f"{scenario_id}.png"


def read_rejects(path: Path | None) -> dict[str, str]:
    """Rejections from a file: a line each, the id, a blank, the reason; lines that begin with # are left out.

    Args:
        path: the file; None holds none.

    Returns:
        Reasons by id.

    Raises:
        ScenarioError: it cannot be read, or an id has no reason.
    """
    if path is None:
        return {}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise ScenarioError(f"--rejects {path} cannot be read: {err}") from None
    found = {}
    for number, line in enumerate(lines, 1):
        one, _, reason = line.strip().partition(" ")
        if one and not one.startswith("#"):
            if not reason.strip():
                raise ScenarioError(f"{path}, line {number}: {one:.140} has no reason; write: ID REASON")
            found[one] = reason.strip()
    return found
