"""What is asked of a validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.curation.validate.validation import ValidationRule
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.options import option
from lerobot_roborecover.workers.backend import LOCAL, Backend


@dataclass(frozen=True, kw_only=True)
class ValidationRequest:
    """What to validate and how."""

    dataset: Path = option(positional=True)
    """Folder of a screened scenario dataset."""
    trials_folder: Path | None = option(None, metavar="DIR")
    """Where screen kept the trials.

    One folder a policy.
    """
    states: bool = False
    """Only replay the prefixes of a set that was made elsewhere or by an earlier version, and write the
    hashes of their states: no scenario is judged, and nothing else changes."""
    candidates: Sequence[Path] = option((), metavar="DIR")
    """Candidate dataset that the scenarios were made from: original poses and frames; may be given again."""
    out: Path
    """Folder of the new dataset.

    An earlier validation's that nothing was made of is replaced.
    """
    rule: ValidationRule = field(default_factory=ValidationRule)
    env: Sequence[str] = option((), metavar="KEY=VALUE")
    """Option of the recovery env type, as the originals were rendered; may be given again."""
    reject: Sequence[str] = option((), metavar="ID")
    """On looking at the sheets; repeat it."""
    reason: str = ""
    """Why, for every --reject."""
    rejects_file: Path | None = option(None, name="rejects", metavar="FILE")
    """The same as a file: a line each, the id, a blank, the reason."""
    accepts: Sequence[str] = option((), name="accept", metavar="ID")
    """Take a rejection back."""
    by: str = option("a person", metavar="NAME")
    """Who looked.

    Goes into the decisions.
    """
    workers: int = option(0, name="num-workers", old=("workers",))
    """Processes that replay (1, or every CPU of a cluster)."""
    workplace: Backend = LOCAL
    """Where they are."""
    limit_s: float = 900
    """For one scenario's replays."""
    work: Path | None = option(None, metavar="DIR")
    """Replays and sheets, kept between runs (OUT.replays)."""

    @property
    def trials(self) -> Path:
        """The trials' folder.

        Raises:
            OptionError: none is given.
        """
        if self.trials_folder is None:
            raise OptionError(
                "--trials-folder is missing: name the folder of trials that roborecover curate screen kept"
            )
        return self.trials_folder

    @property
    def rejects(self) -> dict[str, str]:
        """Reasons by id of scenarios that a person rejects.

        Raises:
            ScenarioError: the file of rejections cannot be read, or an id has no reason.
        """
        return read_rejects(self.rejects_file) | dict.fromkeys(self.reject, self.reason)

    @property
    def folder(self) -> Path:
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
