"""Which files a dataset may hold, and whether a file is what its name says.

Published and pulled datasets hold parquet, JSON, video, pictures and text; nothing that runs code when it is
loaded. Everything else is refused by name.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from lerobot_roborecover.datasets.files import finish_update, is_update_file, load_json
from lerobot_roborecover.scenario import ScenarioError

MAX_FILES = 100_000
MAX_FILE_BYTES = 2**36
MAX_JSON_BYTES = 2**26
MAX_TEXT_BYTES = 2**22

_ALLOWED = (
    r"README\.md|eval\.yaml|\.gitattributes|LICENSE(\.md|\.txt)?|CITATION\.(cff|bib)",
    r"assets/[\w.-]+\.png",
    r"viewer/[\w.-]+\.parquet",
    r"meta/([\w.-]+/)*[\w.-]+\.(parquet|json|jsonl)",
    r"data/([\w.-]+/)*[\w.-]+\.parquet",
    r"videos/([\w.-]+/)*[\w.-]+\.mp4",
    r"images/([\w.-]+/)*[\w.-]+\.png",
)
_NAME = re.compile("|".join(f"(?:{p})" for p in _ALLOWED))
_CODE = (".pkl", ".pickle", ".pt", ".pth", ".bin", ".ckpt", ".npy", ".npz", ".joblib", ".py", ".sh", ".so")
_IGNORED = {".git", ".cache", ".DS_Store", "__pycache__", ".huggingface"}


def check_names(where: str, names: Iterable[str]) -> None:
    """Checks relative paths of a dataset's files.

    Raises:
        ScenarioError: one is no file of a dataset; names it.
    """
    count = 0
    for name in names:
        count += 1
        parts = PurePosixPath(name).parts
        if not _NAME.fullmatch(name) or ".." in parts or "." in parts:
            kind = (
                "a kind of file that can run code when it is loaded, which is never pulled or published"
                if name.lower().endswith(_CODE)
                else "not part of a dataset (parquet and JSON below meta/, data/*.parquet, videos/*.mp4, "
                "images/ and assets/*.png, viewer/*.parquet, eval.yaml, README.md, LICENSE)"
            )
            raise ScenarioError(f"{where}: {name[:200]!r} is {kind}. Remove it from the dataset")
    if count > MAX_FILES:
        raise ScenarioError(f"{where} has {count} files; the limit is {MAX_FILES}")


def list_files(root: Path) -> list[str]:
    """Relative paths of a local dataset's files, sorted; caches and version control left out.

    Raises:
        ScenarioError: a link, or a file that is no part of a dataset.
    """
    finish_update(root)
    names = []
    for folder, folders, files in os.walk(root):
        ours = Path(folder) == root
        folders[:] = sorted(d for d in folders if d not in _IGNORED and not (ours and is_update_file(d)))
        files = [name for name in files if not (ours and is_update_file(name))]
        for name in (*folders, *files):
            path = Path(folder) / name
            if path.is_symlink():
                raise ScenarioError(
                    f"{path} is a link; a dataset holds its files themselves. Put the file in its place"
                )
        for name in files:
            path = Path(folder) / name
            if name not in _IGNORED:
                if not path.is_file():
                    raise ScenarioError(f"{path} is not a regular file; remove it from the dataset")
                names.append(path.relative_to(root).as_posix())
    check_names(str(root), names)
    return sorted(names)


def check_file(root: Path, name: str) -> None:
    """Checks that a file is what its name says, without decoding more of it than that takes.

    Raises:
        ScenarioError: it is something else, or claims more than it can hold.
    """
    path = root / name
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(12)
        file.seek(max(size - 4, 0))
        tail = file.read(4)
    suffix = path.suffix
    good = {
        ".parquet": head[:4] == b"PAR1" and tail == b"PAR1",
        ".mp4": head[4:8] == b"ftyp",
        ".png": head[:8] == b"\x89PNG\r\n\x1a\n",
    }.get(suffix, True)
    if not good:
        raise ScenarioError(
            f"{name} is not a {suffix[1:]} file: it starts with {head!r}. Fetch or write the dataset again"
        )
    if suffix == ".parquet":
        _check_parquet(path)
    elif suffix in (".json", ".jsonl"):
        _check_json(path, name, size)
    elif suffix not in (".mp4", ".png") and (size > MAX_TEXT_BYTES or b"\0" in path.read_bytes()):
        raise ScenarioError(f"{name} is not text of at most {MAX_TEXT_BYTES} bytes")


def _check_parquet(path: Path) -> None:
    from lerobot_roborecover.datasets.parquet_read import open_parquet

    with open_parquet(path):
        pass


def _check_json(path: Path, name: str, size: int) -> None:
    if size > MAX_JSON_BYTES:
        raise ScenarioError(f"{name} has {size} bytes; the limit of a JSON file is {MAX_JSON_BYTES}")
    text = path.read_bytes()
    try:
        for line in io.BytesIO(text) if path.suffix == ".jsonl" else [text]:
            load_json(line)
    except (ValueError, RecursionError) as err:
        raise ScenarioError(f"{name} is not JSON ({err}); fetch or write the dataset again") from None
