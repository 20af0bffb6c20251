"""The one rule for the files that commands write: no result is replaced unless the user says so.

- A result that exists is refused. Where a command has `--force`, that replaces it.
- A page that is made from results, such as a report, replaces an earlier page of the same command, and
  no other file of those names.
- A file that a process has locked, such as the log of a running evaluation, is never replaced
  (`atomic_io.atomic_file`).

Folders of datasets are new or empty (`atomic_io.check_new`).
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path

from lerobot_roborecover.errors import RoboRecoverError
from lerobot_roborecover.utils.atomic_io import atomic_write, check_unlocked

_MADE_BY = b"Made by roborecover"
"""In the footer of every HTML page of this package."""
_UNFINISHED = b"<!doctype html><p>This page was not finished.</p><footer><p>" + _MADE_BY + b"</p></footer>\n"
_MAX_PAGE_BYTES = 2**30


class OutputExistsError(RoboRecoverError, ValueError):
    """What a command would write exists already; the message says what to do."""


def check_new_file(path: Path, *, force: bool = False, inputs: Iterable[Path] = ()) -> None:
    """Checks that a result can be written to a file.

    Args:
        path: the file.
        force: whether an earlier file may be replaced.
        inputs: files that the result is made from, which it never replaces.

    Raises:
        OutputExistsError: the file exists and may not be replaced, or is no regular file.
        InUseError: another process has locked it.
    """
    if path.is_symlink() or path.exists():
        for source in inputs:
            if source.exists() and path.exists() and path.samefile(source):
                raise OutputExistsError(f"{path} is also an input and is not replaced. Name another file")
        if not path.is_file():
            raise OutputExistsError(f"{path} exists and is not a regular file. Name another file")
        check_unlocked(path)
        if not force:
            raise OutputExistsError(
                f"{path} exists and is not replaced. Name another file, or replace it with --force"
            )


def check_page(
    folder: Path,
    names: Sequence[str],
    made_here: Callable[[Path], bool] | None = None,
) -> None:
    """Checks that a page and its files can be written to a folder.

    Args:
        folder: of the page; made by the caller if need be. Its files of other names stay.
        names: files and folders that are written there, the main page first.
        made_here: whether a file is an earlier main page; by default, whether it is an HTML page of
            this package.

    Raises:
        OutputExistsError: a file or folder of these names exists that this command did not make.
    """
    if (folder.exists() and not folder.is_dir()) or (folder.is_symlink() and not folder.exists()):
        raise OutputExistsError(f"{folder} is not a folder. Name another --out")
    main = folder / names[0]
    if main.is_file() and (made_here or _has_footer)(main):
        return
    found = [name for name in names if (folder / name).is_symlink() or (folder / name).exists()]
    if found:
        raise OutputExistsError(
            f"{folder / found[0]} exists and was not made by this command, so it is not replaced. Name "
            "another --out, or move the file away"
        )


@contextmanager
def claim_page(folder: Path, names: Sequence[str]) -> Generator[None]:
    """Marks a folder as one of an HTML page while the block writes it.

    A page that a crash cut short is made anew by the next run. An error before the first file leaves nothing.

    Args:
        folder: of the page; made if need be.
        names: as in `check_page`.

    Raises:
        OutputExistsError: a file or folder of these names exists that this command did not make.
    """
    check_page(folder, names)
    page, others = folder / names[0], [folder / name for name in names[1:]]
    marked = not page.exists()
    if marked:
        atomic_write(page, _UNFINISHED)
    try:
        yield
    except Exception:
        if marked and not any(_holds_a_file(path) for path in others):
            page.unlink(missing_ok=True)
            for path in others:  # at most empty folders
                shutil.rmtree(path, ignore_errors=True)
        raise


def _holds_a_file(path: Path) -> bool:
    return path.is_file() or any(inner.is_file() for inner in path.rglob("*"))


def _has_footer(page: Path) -> bool:
    try:
        return page.stat().st_size <= _MAX_PAGE_BYTES and _MADE_BY in page.read_bytes()
    except OSError:
        return False
