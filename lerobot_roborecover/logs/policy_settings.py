"""The settings of a policy in a trial row, as reports compare them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

UNKNOWN_WEIGHTS = "server_weights"
"""The setting that says that nothing is known of a server's weights."""
OBJECT = "policy"
"""The setting that holds a policy's identity where the user gave it another name."""
CALLABLE = "callable"
"""Policy type of a Python callable."""
_VOUCHED = (OBJECT, UNKNOWN_WEIGHTS, "server", "device")
"""Settings that may differ between the runs of one method."""


def settings_of_method(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings that all runs of one method share."""
    return {k: v for k, v in settings.items() if k not in _VOUCHED}


def digest_of(content: Any) -> str:
    """Returns a short hash of JSON-able content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:12]


def short_identity(identity: str) -> str:
    """Returns the first characters of an identity's hash: `callable@1a2b3c4d5e6f` is `1a2b3c`."""
    return identity.rpartition("@")[2].removeprefix("run-")[:6]
