"""Prints what an extra of pyproject.toml asks for, so that its packages can be installed without this one's.

uv pip install $(python scripts/extra.py lint)
"""

import sys
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8"))["project"]
extras = project["optional-dependencies"]
for name in sys.argv[1:]:
    if name not in extras:
        sys.exit(f"no extra {name!r} in pyproject.toml; there are {', '.join(extras)}")
    print(*extras[name], sep="\n")
