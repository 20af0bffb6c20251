"""Hub calls again after failures that pass by themselves, and every other failure as one clear refusal."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

import httpx
from huggingface_hub.errors import (
    GatedRepoError,
    HfHubHTTPError,
    HFValidationError,
    LocalTokenNotFoundError,
    OfflineModeIsEnabled,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)

from lerobot_roborecover.scenario import ScenarioError

logger = logging.getLogger(__name__)

ATTEMPTS = 5
FIRST_WAIT_S = 1.0
LONGEST_WAIT_S = 60.0
_PASSING = (408, 429, 500, 502, 503, 504)


class HubUnreachable(ScenarioError):
    """The Hub did not answer, or not properly; nothing is known about what is on it."""


_LOGIN = "Log in with `hf auth login`, or set HF_TOKEN to a token that may do this"


def retry[T](
    call: Callable[[], T],
    what: str,
    passing: tuple[type[Exception], ...] = (),
    attempts: int = ATTEMPTS,
) -> T:
    """Calls the Hub; dropped connections, 429 and 5xx are tried again with growing waits.

    Args:
        call: must be safe to repeat.
        what: for messages, e.g. "Hub dataset org/name: creating it".
        passing: errors that are an answer to the caller, and are raised as they are.
        attempts: how often to try.

    Raises:
        HubUnreachable: the Hub still does not answer after the last attempt.
        ScenarioError: it refuses.
    """
    for attempt in range(1, attempts + 1):
        try:
            return call()
        except (ScenarioError, *passing):
            raise
        except Exception as err:
            cause = _cause(err)
            if cause is None:
                raise
            wait = _wait_s(cause, attempt)
            if wait is None or attempt == attempts:
                kind = HubUnreachable if _silent(cause) else ScenarioError
                raise kind(f"{what}: {_said(cause, attempt)}") from err
            logger.warning("%s: %s; attempt %d of %d in %.0f s", what, cause, attempt + 1, attempts, wait)
            time.sleep(wait)
    raise AssertionError("unreachable")


def _cause(err: BaseException) -> Exception | None:
    """The Hub's or the network's error in a chain of errors; uploads wrap theirs."""
    seen: BaseException | None = err
    while seen is not None:
        if isinstance(
            seen,
            HfHubHTTPError | httpx.HTTPError | HFValidationError | LocalTokenNotFoundError | ConnectionError,
        ):
            return seen
        seen = seen.__cause__
    return None


def _status(err: Exception) -> int:
    return err.response.status_code if isinstance(err, HfHubHTTPError) else 0


def _wait_s(err: Exception, attempt: int) -> float | None:
    """Seconds to wait before another attempt; None where none makes sense."""
    if isinstance(err, HFValidationError | LocalTokenNotFoundError | OfflineModeIsEnabled):
        return None
    if isinstance(err, HfHubHTTPError):
        if _status(err) not in _PASSING:
            return None
        asked = err.response.headers.get("Retry-After", "")
        if asked.isdigit():
            return min(float(asked), LONGEST_WAIT_S)
    return min(FIRST_WAIT_S * 2 ** (attempt - 1), LONGEST_WAIT_S)


def _silent(err: Exception) -> bool:
    """Whether the Hub did not answer, rather than refuse."""
    if isinstance(err, HFValidationError | LocalTokenNotFoundError):
        return False
    return _status(err) in (0, *_PASSING)


def _said(err: Exception, attempts: int) -> str:
    status = _status(err)
    if isinstance(err, OfflineModeIsEnabled):
        return "HF_HUB_OFFLINE is set, so that the Hub is not asked. Unset it and run the command again"
    if isinstance(err, HFValidationError):
        return f"not a valid Hub id ({err})"
    if isinstance(err, LocalTokenNotFoundError) or (
        status == 401 and not isinstance(err, RepositoryNotFoundError)
    ):
        return f"not logged in, or the token is not valid (HTTP 401). {_LOGIN}"
    if isinstance(err, GatedRepoError):
        return "it is gated: accept its terms on its page on the Hub, then log in with `hf auth login`"
    if isinstance(err, RevisionNotFoundError):
        return "there is no such tag, branch or commit. Check the revision"
    if isinstance(err, RepositoryNotFoundError):
        return f"it does not exist, or is private and you may not see it. Check the id. {_LOGIN}"
    if status == 403:
        return f"the token may not do this (HTTP 403). {_LOGIN}: with write access, for an organisation"
    if status in (409, 412):
        return (
            f"another commit changed it at the same time (HTTP {status}). Look at that commit, then run the "
            "command again"
        )
    if status == 429:
        return "the Hub asks to slow down (HTTP 429). Run the command again later: what is uploaded is kept"
    if status in _PASSING or not status:
        tried = f"{attempts} attempts" if attempts > 1 else "one attempt"
        return (
            f"the Hub did not answer properly after {tried} ({type(err).__name__}: "
            f"{str(err)[:200]}). Check the connection and run the command again: what is transferred is kept"
        )
    return f"the Hub refused (HTTP {status}: {str(err)[:300]})"
