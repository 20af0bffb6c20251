"""Hooks of MkDocs: pages that lie at the root of the repository, and links that leave `docs/`.

On GitHub a page links to `../CONTRIBUTING.md` or `../examples/crane`. In the site the former is a page of its
own, and the latter goes to the repository, where its address is known (`GITHUB_REPOSITORY`, as GitHub's
workflows have it, or `repo_url` in mkdocs.yml); otherwise the words stay without a link.
"""

from __future__ import annotations

import os
import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
PAGES = ("CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md", "CODE_OF_CONDUCT.md")
_LINK = re.compile(r"(?<!!)\[(?P<words>[^\[\]]+)\]\((?P<target>[^()\s:]+)\)")
_FENCE = re.compile(r"^(```.*?^```)", re.DOTALL | re.MULTILINE)


def on_files(files, config):
    """Adds the pages of the repository's root."""
    for name in PAGES:
        files.append(File.generated(config, name, content=(ROOT / name).read_text("utf-8")))
    return files


def on_page_markdown(markdown, page, config, files):
    """Turns links from where a page lies in the repository to where it lies in the site."""
    source = page.file.src_uri
    folder = "" if source in PAGES else posixpath.dirname(f"docs/{source}")

    def turned(match):
        path, hash_sign, anchor = match["target"].partition("#")
        if not path:
            return match[0]
        target = posixpath.normpath(posixpath.join(folder, path))
        inside = (
            target.removeprefix("docs/") if target.startswith("docs/") else target if target in PAGES else ""
        )
        if inside:
            return f"[{match['words']}]({_from(source, inside)}{hash_sign}{anchor})"
        if not (ROOT / target).exists():
            return match[0]  # for MkDocs to complain of
        repository = _repository(config)
        return f"[{match['words']}]({repository}/blob/main/{target})" if repository else match["words"]

    parts = _FENCE.split(markdown)
    return "".join(p if p.startswith("```") else _LINK.sub(turned, p) for p in parts)


def _from(source: str, target: str) -> str:
    return posixpath.relpath(target, posixpath.dirname(source) or ".")


def _repository(config) -> str:
    named = os.environ.get("GITHUB_REPOSITORY")
    return (config.repo_url or (f"https://github.com/{named}" if named else "")).rstrip("/")
