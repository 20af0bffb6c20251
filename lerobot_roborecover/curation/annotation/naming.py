"""Names for people: `wrist camera` and `black bowl` instead of `observation.images.image2` and
`akita_black_bowl_1_main`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

_WORDS = {
    "akita black bowl": "black bowl",
    "glazed rim porcelain ramekin": "ramekin",
    "bbq sauce": "BBQ sauce",
    "obj": "object",
    "cmbutton": "coffee button",
    "hammerbody": "hammer",
    "nail link": "nail",
    "bsktball": "basketball",
    "boxbodytop": "box lid",
}
"""What simulators' authors call things, where taking the name apart does not say it."""
_LABELLED = re.compile(r"(?P<kind>.+?)_(?P<number>\d+)(?:_(?P<part>[a-z_]+))?")
"""LIBERO's bodies: kind, number of its kind, part."""
_RESERVED = "hand"
"""The row of the end effector."""
_CAMERAS = {
    "image": "front camera",
    "image2": "wrist camera",
    "agentview": "front camera",
    "robot0_eye_in_hand": "wrist camera",
    "left_camera": "left wrist camera",
    "right_camera": "right wrist camera",
}
"""LeRobot's names of LIBERO's and RoboTwin's cameras; others are taken apart."""


def camera_labels(cameras: Sequence[str]) -> dict[str, str]:
    """A name for people by camera; where two would be equal, what was recorded."""
    raw = {c: c.removeprefix("observation.").removeprefix("images.") for c in cameras}
    if len(cameras) == 1 and raw[cameras[0]] in ("image", "pixels"):
        return {cameras[0]: "camera"}
    found = {}
    for camera, name in raw.items():
        plain = name.removesuffix("_image")
        words = re.sub(r"\d+$", "", re.sub(r"[_.]+", " ", plain).removesuffix(" camera"))
        found[camera] = _CAMERAS.get(plain) or f"{words} camera"
    return _unique(found, raw)


def hand_label(body: str) -> str:
    """A name for an end effector: `eef`, `eef_left`."""
    side = body.removeprefix("eef").strip("_").replace("_", " ")
    return f"{side} {_RESERVED}".strip()


def body_labels(bodies: Iterable[str]) -> dict[str, str]:
    """A name for people by body: without makers' words and part names, numbered only where there are several
    of a kind. All are different, and none is a plain number or the end effector's."""
    names = list(bodies)
    plain = {n: _plain(n) for n in names}
    several = Counter(words for words, _ in plain.values())
    labels = {
        n: f"{words} {number}".strip() if several[words] > 1 else words
        for n, (words, number) in plain.items()
    }
    return _unique(labels, {n: n for n in names})


def _plain(body: str) -> tuple[str, str]:
    """A body's words, and its number where it only tells it from others of its kind."""
    match = _LABELLED.fullmatch(body)
    if match is None:
        words = re.sub(r"(?<=[a-z])(?=[A-Z0-9])|[_.]+", " ", body).strip().lower()
        return _worded(words), ""
    kind, part = _worded(match["kind"].replace("_", " ")), (match["part"] or "main").replace("_", " ")
    if part == "main":
        return kind, match["number"]
    thing = kind.split()[-1]
    return (part if part.split()[0] == thing else f"{thing} {part}"), match["number"]


def _worded(words: str) -> str:
    found = _WORDS.get(words, words)
    return f"object {found}" if found == _RESERVED or not re.search(r"[^\W\d]", found) else found


def _unique(labels: Mapping[str, str], raw: Mapping[str, str]) -> dict[str, str]:
    count = Counter(labels.values())
    return {n: label if count[label] == 1 else f"{label} ({raw[n]})" for n, label in labels.items()}
