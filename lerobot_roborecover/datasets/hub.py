"""Pulls `meta/roborecover/` of a Hub dataset, and nothing else of it."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import httpx
from huggingface_hub import HfApi, snapshot_download
from huggingface_hub.errors import (
    EntryNotFoundError,
    GatedRepoError,
    HfHubHTTPError,
    HFValidationError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.hf_api import RepoFile

from lerobot_roborecover.datasets.certificate import CERTIFICATE_FILE, MAX_CERTIFICATE_BYTES
from lerobot_roborecover.datasets.schema import (
    FOLDER,
    MANIFEST_FILE,
    MAX_MANIFEST_BYTES,
    MAX_PARQUET_BYTES,
    SCENARIOS_FILE,
)
from lerobot_roborecover.scenario import ScenarioError

logger = logging.getLogger(__name__)

_LIMITS = {f"{FOLDER}/{MANIFEST_FILE}": MAX_MANIFEST_BYTES, f"{FOLDER}/{SCENARIOS_FILE}": MAX_PARQUET_BYTES}
_CERTIFICATE = f"{FOLDER}/{CERTIFICATE_FILE}"
"""Pulled where there is one."""
_COMMIT = re.compile(r"[0-9a-f]{40}")


def pull(repo_id: str, revision: str | None) -> tuple[Path, str]:
    """Downloads the scenario files of a Hub dataset, or finds them in the Hub cache.

    Args:
        repo_id: "org/name".
        revision: tag, branch or commit; None takes the default branch and warns with the commit to pin.

    Returns:
        The snapshot's folder and its commit.

    Raises:
        ScenarioError: the dataset cannot be reached or read, or holds no scenarios; with the remedy.
    """
    where = f"Hub dataset {repo_id}" + (f" at revision {revision!r}" if revision else "")
    folder = cached_folder(repo_id, revision) if revision and _COMMIT.fullmatch(revision) else None
    try:
        folder = folder or _download(where, repo_id, revision)
    except GatedRepoError as err:
        raise ScenarioError(
            f"{where} is gated: accept its terms on its page on the Hub, then log in with `hf auth login` "
            "or set HF_TOKEN"
        ) from err
    except RevisionNotFoundError as err:
        raise ScenarioError(
            f"{where}: the dataset has no such tag, branch or commit. Check the revision"
        ) from err
    except RepositoryNotFoundError as err:
        raise ScenarioError(
            f"{where} does not exist, or is private and you are not logged in. Check the id; for a private "
            "dataset log in with `hf auth login` or set HF_TOKEN"
        ) from err
    except HFValidationError as err:
        raise ScenarioError(f"{where}: not a valid Hub id ({err})") from err
    except (HfHubHTTPError, httpx.HTTPError, OSError) as err:
        status = err.response.status_code if isinstance(err, HfHubHTTPError) else 0
        if status in (401, 403):
            raise ScenarioError(
                f"{where}: access refused (HTTP {status}). Log in with `hf auth login`, or set HF_TOKEN to "
                "a token that may read it"
            ) from err
        folder = cached_folder(repo_id, revision)
        if folder is None:
            raise ScenarioError(
                f"{where} could not be downloaded ({type(err).__name__}: {str(err)[:200]}), and the Hub "
                "cache has no complete copy. Check the connection and HF_HUB_OFFLINE and try again, or pass "
                "a local folder"
            ) from err
        logger.warning("%s: the Hub did not answer (%s); using the cached commit %s", where, err, folder.name)
    commit = folder.name
    if revision is None:
        logger.warning("%s: no revision given; read commit %s. To repeat this run, pin it", where, commit)
    return folder, commit


def _download(where: str, repo_id: str, revision: str | None) -> Path:
    """Checks the sizes the Hub gives, then downloads the two files, and the certificate."""
    names = [*_LIMITS, _CERTIFICATE]
    sizes = {
        info.path: info.size
        for info in HfApi().get_paths_info(repo_id, names, repo_type="dataset", revision=revision)
        if isinstance(info, RepoFile)
    }
    if sizes.get(_CERTIFICATE, 0) > MAX_CERTIFICATE_BYTES:
        names.remove(_CERTIFICATE)
    for path, limit in _LIMITS.items():
        if path not in sizes:
            raise ScenarioError(
                f"{where} holds no {path}: it is not a scenario dataset, or not at this revision. Check the "
                "id"
            )
        if sizes[path] > limit:
            raise ScenarioError(f"{where}: {path} has {sizes[path]} bytes; the limit is {limit}")
    return Path(snapshot_download(repo_id, repo_type="dataset", revision=revision, allow_patterns=names))


def cached_folder(repo_id: str, revision: str | None) -> Path | None:
    """The snapshot in the Hub cache, if it holds both files."""
    try:
        folder = Path(
            snapshot_download(
                repo_id,
                repo_type="dataset",
                revision=revision,
                allow_patterns=list(_LIMITS),
                local_files_only=True,
            )
        )
    except (EntryNotFoundError, HFValidationError, OSError):
        return None
    return folder if all((folder / path).is_file() for path in _LIMITS) else None
