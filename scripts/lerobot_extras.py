"""Prints the extras of LeRobot that this package asks for, and those that they ask for, separated by commas.

uv's overrides say all of a requirement: `lerobot[dataset] @ file:///…` stands in place of every other one of
LeRobot, those in LeRobot's own extras too. Argument: the source tree of LeRobot.
"""

import re
import sys
import tomllib
from pathlib import Path


def asked_for(requirements: list[str]) -> set[str]:
    """Extras of LeRobot in a list of requirements."""
    found = (re.match(r"lerobot\[([^]]*)\]", one) for one in requirements)
    return {name.strip() for match in found if match for name in match[1].split(",")}


def closure(names: set[str], extras: dict[str, list[str]]) -> set[str]:
    """These extras and all that they lead to; those that LeRobot has not are left out."""
    known: set[str] = set()
    while names := names & extras.keys() - known:
        known |= names
        names = asked_for([one for name in names for one in extras[name]])
    return known


def _project(folder: Path) -> dict:
    return tomllib.loads((folder / "pyproject.toml").read_text("utf-8"))["project"]


if __name__ == "__main__":
    ours, theirs = _project(Path(__file__).parents[1]), _project(Path(sys.argv[1]))
    wanted = [ours["dependencies"], *ours["optional-dependencies"].values()]
    found = closure(asked_for([one for few in wanted for one in few]), theirs["optional-dependencies"])
    print(",".join(sorted(found)))
