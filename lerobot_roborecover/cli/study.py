"""`roborecover study`, which is `python -m recipes.study` in a clone."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from lerobot_roborecover.errors import OptionError

HELP = "re-run a study, in a clone of the repository: python -m recipes.study"


def pass_through(argv: Sequence[str]) -> int:
    """Hands the whole command line to the clone that this is run in."""
    if not Path("recipes/study/__main__.py").is_file():
        raise OptionError(
            "studies are not installed. Run them in the top folder of a clone of the repository: "
            "python -m recipes.study"
        )
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    return importlib.import_module("recipes.study.__main__").main(argv)
