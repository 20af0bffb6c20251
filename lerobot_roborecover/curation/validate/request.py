"""What is asked of a validation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.curation.validate.validation import ValidationRule


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
    workers: int = 1
    limit_s: float = 900.0
    """Longest that all replays of one scenario may take."""
    work: Path | None = None
    """Working folder; None takes `OUT.replays`."""

    @property
    def folder(self) -> Path:
        """The working folder."""
        return self.work or self.out.with_name(f"{self.out.name}.replays")
