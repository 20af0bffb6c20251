"""Where scenarios come from: whether the Hub answers, and what recorded the shipped sets."""

from __future__ import annotations

import os
import urllib.error
import urllib.request
from collections.abc import Mapping

from lerobot_roborecover.datasets.load import builtin_names, load_scenarios
from lerobot_roborecover.platforms.base import Platform
from lerobot_roborecover.platforms.findings import Check, Status

_HUB = "https://huggingface.co"
_HUB_TIMEOUT_S = 5.0
_TRUE = {"1", "on", "yes", "true"}


def check_hub() -> Check:
    """Whether the Hugging Face Hub, or the mirror that HF_ENDPOINT names, answers."""
    name = "Hub"
    remedy = "local checkpoints, local scenario folders and the shipped sets work without it"
    if os.environ.get("HF_HUB_OFFLINE", "").lower() in _TRUE:
        return Check(
            name, Status.WARNING, "not asked: HF_HUB_OFFLINE is set", f"unset it to download; {remedy}"
        )
    endpoint = os.environ.get("HF_ENDPOINT") or _HUB
    try:
        with urllib.request.urlopen(f"{endpoint.rstrip('/')}/api/models?limit=1", timeout=_HUB_TIMEOUT_S):
            pass
    except urllib.error.HTTPError as err:
        return Check(
            name,
            Status.WARNING,
            f"{endpoint} answers with status {err.code}",
            "check HF_ENDPOINT and proxies",
        )
    except (OSError, ValueError) as err:
        why = getattr(err, "reason", err)
        return Check(
            name, Status.WARNING, f"{endpoint} does not answer ({why})", f"check the network; {remedy}"
        )
    return Check(name, Status.OK, f"{endpoint} answers")


def recorded_by(platform: Platform) -> Mapping[str, str]:
    """What recorded the set that a platform ships with, by name of package or file; nothing is downloaded."""
    if platform.default_scenarios not in builtin_names():
        return {}
    recorded = next(iter(load_scenarios(platform.default_scenarios))).fingerprint
    return recorded.versions if recorded else {}
