"""Option fields with an earlier name, which works for one release and prints the new one."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import suppress
from typing import Any


def move_old_fields(config: Any, prefix: str, names: Mapping[str, str]) -> None:
    """Moves values given under old names to the fields of today, and prints the new names.

    Args:
        config: a dataclass whose old fields are None where they are not given.
        prefix: of its options on the command line, e.g. `--env.`.
        names: old field to new field.
    """
    for old, new in names.items():
        value = getattr(config, old)
        if value is None:
            continue
        setattr(config, new, value)
        setattr(config, old, None)
        with suppress(OSError):  # standard error may be closed
            print(f"note: {prefix}{old} is now {prefix}{new}", file=sys.stderr)
