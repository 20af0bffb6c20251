"""Whether a GR00T server looks at what a mapping gives, and gives what it takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from lerobot_roborecover.policies.remote.errors import MappingError
from lerobot_roborecover.policies.remote.mapping import Mapping as ServerMapping


def check_modalities(declared: Mapping[str, Any], ours: ServerMapping, execute: int | None, url: str) -> None:
    """Refuses a server that looks at, or gives, something else than the mapping, before a simulator starts.

    Args:
        declared: what `get_modality_config` answered, decoded; empty where the server says nothing.
        ours: the mapping.
        execute: actions executed per answer, where that is not all of them.
        url: of the server, for the message.

    Raises:
        MappingError: naming what differs.
    """
    frames = list(range(1 - (ours.window.frames if ours.window else 1), 1))
    timed = {_name(e.under, e.key): e.time_axis for e in (*ours.images, *ours.state)}
    problems: list[str] = []

    def look_at(kind: str, check: Callable[[list[str], list[int]], None]) -> None:
        part = declared.get(kind)
        keys = part.get("modality_keys") if isinstance(part, dict) else None
        steps = part.get("delta_indices") if isinstance(part, dict) else None
        if isinstance(keys, list) and isinstance(steps, list):
            check([str(k) for k in keys], steps)

    def inputs(kind: str) -> Callable[[list[str], list[int]], None]:
        def check(keys: list[str], steps: list[int]) -> None:
            given = sorted(name for name in timed if name.startswith(f"{kind}."))
            for key in keys:
                name = f"{kind}.{key}"
                if name not in timed:
                    problems.append(f"it looks at {name}; the mapping gives {given}")
                elif timed[name] and steps != frames:
                    problems.append(f"it looks at steps {steps} of {name}; the mapping gives {frames}")

        return check

    def language(keys: list[str], steps: list[int]) -> None:
        given = ours.prompt.key
        accepted = (
            {keys[0], *(["annotation.human.coarse_action"] if keys[0] == "task" else [])} if keys else {}
        )
        if accepted and given not in accepted:
            problems.append(f"it reads the instruction at {keys[0]!r:.80}; the mapping gives it at {given!r}")

    def actions(keys: list[str], steps: list[int]) -> None:
        wanted = ours.actions.joined.keys if ours.actions.joined else (ours.actions.key,)
        lacking = [k for k in wanted if k.removeprefix("action.") not in keys]
        if lacking:
            problems.append(f"its actions have no {lacking}; they have {keys}")
        if execute is not None and len(steps) < execute:
            problems.append(f"it gives {len(steps)} actions; {execute} are executed before it is asked again")

    look_at("video", inputs("video"))
    look_at("state", inputs("state"))
    look_at("language", language)
    look_at("action", actions)
    if problems:
        raise MappingError(f"the server at {url} does not fit: {'; '.join(problems)}")


def _name(under: str, key: str) -> str:
    return f"{under}.{key}" if under else key
