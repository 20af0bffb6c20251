"""Puts two videos of `roborecover eval --videos` beside each other: the picture at the top of README.

    python -m scripts.paired_video act=A.mp4 act_clean=B.mp4 docs/images/recovery_pair.webp

Every second step is shown, 20 a second. The shorter video keeps its last frame.
"""

from __future__ import annotations

import sys
from pathlib import Path

import av
from PIL import Image, ImageDraw, ImageFont

SIDE, LABEL, STRIDE, HZ = 300, 26, 2, 20
"""Pixels of a video and of the line above it; steps from one frame to the next; frames a second."""
_COLOURS = {"success": "#1b7f3b", "horizon": "#a33a1d"}


def frames_of(video: Path) -> list[Image.Image]:
    """Every second frame, (SIDE, SIDE) RGB."""
    with av.open(str(video)) as container:
        images = [frame.to_image() for frame in container.decode(video=0)]
    kept = images[::STRIDE] + ([] if len(images) % STRIDE else images[-1:])
    return [image.resize((SIDE, SIDE), Image.Resampling.LANCZOS) for image in kept]


def main(left: str, right: str, out: Path) -> None:
    """Writes the animation; the outcome is the last word of a video's name."""
    named = [argument.partition("=") for argument in (left, right)]
    videos = [frames_of(Path(path)) for _, _, path in named]
    outcomes = [Path(path).stem.rpartition("_")[2] for _, _, path in named]
    length = max(len(video) for video in videos)
    font = ImageFont.load_default(size=15)
    pairs = []
    for k in range(length):
        pair = Image.new("RGB", (2 * SIDE + 4, SIDE + LABEL), "white")
        for j, (video, (name, _, _), outcome) in enumerate(zip(videos, named, outcomes, strict=True)):
            pair.paste(video[min(k, len(video) - 1)], (j * (SIDE + 4), LABEL))
            over = k >= len(video) - 1
            said = f"{name}: {'recovered' if outcome == 'success' else 'not recovered'}" if over else name
            colour = _COLOURS.get(outcome, "black") if over else "black"
            ImageDraw.Draw(pair).text((j * (SIDE + 4) + 6, 4), said, fill=colour, font=font)
        pairs.append(pair)
    durations = [1000 // HZ] * (length - 1) + [1500]
    pairs[0].save(
        out, save_all=True, append_images=pairs[1:], duration=durations, loop=0, quality=60, method=6
    )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
