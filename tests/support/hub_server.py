"""A local stand-in for the Hugging Face Hub, for the real `huggingface_hub` client on the loopback interface.

Keeps datasets in memory as commits of whole trees, and answers what `create_repo`, `upload_folder`,
`create_commit`, tags, refs, trees, `get_paths_info` and `snapshot_download` ask, with the status codes and
`X-` headers of the real one. Every request is logged; any may be made to fail.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import socket
import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, unquote, urlsplit

import yaml

from tests.support.processes import PATIENCE_S

TOKEN = "hf_test"


@dataclass
class Repo:
    """One dataset: whole trees by commit, and refs (branches and tags) to commits."""

    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    refs: dict[str, str] = field(default_factory=dict)
    pull_requests: list[str] = field(default_factory=list)
    """Commits on offer."""
    gated: bool = False
    private: bool = False

    def commit(self, files: dict[str, bytes], branch: str = "main") -> str:
        """Adds a commit whose tree is exactly `files`."""
        sha = hashlib.sha1(f"{len(self.commits)} {sorted(files)}".encode()).hexdigest()
        self.commits[sha] = dict(files)
        self.refs[branch] = sha
        return sha


@dataclass
class HeldInput:
    """A request that waits, so that a test can act while the client is in the middle of it."""

    method: str
    pattern: str
    skip: int
    reached: threading.Event = field(default_factory=threading.Event)
    release: threading.Event = field(default_factory=threading.Event)

    def meets(self, method: str, path: str) -> bool:
        """Whether this request is the one; it is for one request only."""
        if self.reached.is_set() or method != self.method or not re.search(self.pattern, path):
            return False
        self.skip -= 1
        return self.skip < 0


class HubServer(ThreadingHTTPServer):
    """The server; use as a context manager, it listens in a thread of its own."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.repos: dict[str, Repo] = {}
        self.lfs: dict[str, bytes] = {}
        self.parts: dict[tuple[str, int], bytes] = {}
        self.log: list[tuple[str, str]] = []
        """(method, path) of every request."""
        self.cut: set[str] = set()
        """Repository paths whose download ends half way."""
        self.part_bytes: int | None = None
        """Files larger than this are uploaded in parts of this size."""
        self.holds: list[HeldInput] = []
        self.failures: list[list] = []
        """[method, pattern of the path, status, how often]: answered so instead; status 0 drops the
        connection with the request half read."""

    def hold(self, method: str, pattern: str, skip: int = 0) -> HeldInput:
        """Lets the next request of a kind, after `skip` others, wait unanswered until it is released."""
        self.holds.append(HeldInput(method, pattern, skip))
        return self.holds[-1]

    @property
    def endpoint(self) -> str:
        """Base address, for `HF_ENDPOINT`."""
        return f"http://127.0.0.1:{self.server_port}"

    def __enter__(self):
        threading.Thread(target=self.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_):
        self.shutdown()
        self.server_close()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: HubServer

    def log_message(self, *_):
        pass

    def do_GET(self):
        self._route()

    do_HEAD = do_POST = do_PUT = do_DELETE = do_GET  # noqa: N815

    def _route(self):
        path = unquote(urlsplit(self.path).path)
        self.server.log.append((self.command, path))
        length = int(self.headers.get("Content-Length") or 0)
        for failure in self.server.failures:
            method, pattern, status, times = failure
            if times and method == self.command and re.search(pattern, path):
                failure[3] -= 1
                if not status:
                    self.rfile.read(length // 2)
                    self.connection.shutdown(socket.SHUT_RDWR)
                    self.close_connection = True
                    return
                self.rfile.read(length)
                self._send(status, {"error": f"made to fail with {status}"}, {"Retry-After": "0"})
                return
        for hold in self.server.holds:
            if hold.meets(self.command, path):
                hold.reached.set()
                hold.release.wait(PATIENCE_S)
                self.close_connection = True
                return
        body = self.rfile.read(length)
        repo_id = r"(?P<repo>[\w.-]+/[\w.-]+)"
        for pattern, handle in (
            (r"/api/repos/create", self._create),
            (r"/api/validate-yaml", self._validate_yaml),
            (rf"/api/(?:datasets|models)/{repo_id}/preupload/(?P<rev>[^/]+)", self._preupload),
            (rf"/datasets/{repo_id}\.git/info/lfs/objects/batch", self._lfs_batch),
            (r"/lfs/(?P<oid>[0-9a-f]{64})", self._lfs_put),
            (r"/lfs-part/(?P<oid>[0-9a-f]{64})/(?P<number>\d+)", self._lfs_part),
            (r"/lfs-complete", self._lfs_complete),
            (rf"/api/(?:datasets|models)/{repo_id}/commit/(?P<rev>[^/]+)", self._commit),
            (rf"/api/datasets/{repo_id}/leaderboard", self._leaderboard),
            (rf"/api/models/{repo_id}", self._model),
            (rf"/api/datasets/{repo_id}/tag/(?P<rev>[^/]+)", self._tag),
            (rf"/api/datasets/{repo_id}/refs", self._refs),
            (rf"/api/datasets/{repo_id}(?:/revision/(?P<rev>[^/]+))?", self._info),
            (rf"/api/datasets/{repo_id}/tree/(?P<rev>[^/]+)(?:/.*)?", self._tree),
            (rf"/api/datasets/{repo_id}/paths-info/(?P<rev>[^/]+)", self._paths_info),
            (rf"(?:/datasets)?/{repo_id}/resolve/(?P<rev>[^/]+)/(?P<file>.+)", self._resolve),
        ):
            if match := re.fullmatch(pattern, path):
                names = match.groupdict()
                if "repo" in names and not self._may_use(names["repo"]):
                    return
                handle(body, **names)
                return
        self._send(404, {"error": f"no route for {path}"})

    def _send(self, status: int, payload=None, headers=None, raw: bytes | None = None):
        data = raw if raw is not None else json.dumps(payload).encode()
        self.send_response(status)
        headers = {"Content-Type": "application/json", "Content-Length": str(len(data)), **(headers or {})}
        for key, value in headers.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def _refuse(self, status: int, code: str, message: str):
        self._send(status, {"error": message}, {"X-Error-Code": code, "X-Error-Message": message})

    def _may_use(self, repo_id: str) -> bool:
        known = self.headers.get("Authorization") == f"Bearer {TOKEN}"
        repo = self.server.repos.get(repo_id)
        if repo is None or (repo.private and not known):
            self._refuse(404 if known else 401, "RepoNotFound", "Repository not found")
            return False
        if repo.gated and not known:
            self._refuse(401, "GatedRepo", "Access to this dataset is restricted")
            return False
        return True

    def _commit_of(self, repo_id: str, revision: str | None) -> str | None:
        repo = self.server.repos[repo_id]
        sha = repo.refs.get(revision or "main", revision)
        if sha not in repo.commits:
            self._refuse(404, "RevisionNotFound", f"Invalid rev id: {revision}")
            return None
        return sha

    def _create(self, body):
        payload = json.loads(body)
        repo_id = f"{payload['organization']}/{payload['name']}"
        if self.headers.get("Authorization") != f"Bearer {TOKEN}":
            self._send(401, {"error": "Invalid credentials"})
            return
        url = {"url": f"{self.server.endpoint}/datasets/{repo_id}"}
        if repo_id in self.server.repos:
            self._send(409, {"error": "You already created this dataset repo", **url})
            return
        seen = payload.get("visibility") or ("private" if payload.get("private") else "public")
        self.server.repos[repo_id] = Repo(private=seen == "private")
        self.server.repos[repo_id].commit({".gitattributes": b""})
        self._send(200, url)

    def _validate_yaml(self, body):
        self._send(200, {"errors": [], "warnings": []})

    def _preupload(self, body, repo, rev):
        files = json.loads(body)["files"]
        modes = ["lfs" if f["path"].endswith(".parquet") else "regular" for f in files]
        answers = [
            {"path": f["path"], "uploadMode": mode, "shouldIgnore": False}
            for f, mode in zip(files, modes, strict=True)
        ]
        self._send(200, {"files": answers})

    def _lfs_batch(self, body, repo):
        # Content that has arrived is not asked for again.
        objects = [
            o if o["oid"] in self.server.lfs else {**o, "actions": {"upload": self._upload_of(**o)}}
            for o in json.loads(body)["objects"]
        ]
        self._send(200, {"transfer": "multipart" if self.server.part_bytes else "basic", "objects": objects})

    def _upload_of(self, oid: str, size: int) -> dict:
        """How an object is to be sent: whole, or in parts and then a word that all are there."""
        part = self.server.part_bytes
        if part is None or size <= part:
            return {"href": f"{self.server.endpoint}/lfs/{oid}"}
        parts = {str(n): f"{self.server.endpoint}/lfs-part/{oid}/{n}" for n in range(1, -(-size // part) + 1)}
        return {"href": f"{self.server.endpoint}/lfs-complete", "header": {"chunk_size": str(part), **parts}}

    def _lfs_part(self, body, oid, number):
        self.server.parts[(oid, int(number))] = body
        self._send(200, {}, {"ETag": hashlib.md5(body).hexdigest()})

    def _lfs_complete(self, body):
        said = json.loads(body)
        numbers = [p["partNumber"] for p in said["parts"]]
        parts = [self.server.parts[(said["oid"], n)] for n in numbers]
        whole = numbers == sorted(numbers) and hashlib.sha256(b"".join(parts)).hexdigest() == said["oid"]
        if whole:
            self.server.lfs[said["oid"]] = b"".join(parts)
        self._send(200 if whole else 400, {})

    def _lfs_put(self, body, oid):
        whole = hashlib.sha256(body).hexdigest() == oid
        if whole:
            self.server.lfs[oid] = body
        self._send(200 if whole else 400, {})

    def _commit(self, body, repo, rev):
        head = self.server.repos[repo].refs[rev]
        files = dict(self.server.repos[repo].commits[head])
        for entry in map(json.loads, body.splitlines()):
            value = entry["value"]
            if entry["key"] == "header" and value.get("parentCommit", head) != head:
                self._send(412, {"error": "A commit has happened since. Please refresh and try again."})
                return
            if entry["key"] == "deletedFile":
                del files[value["path"]]
            elif entry["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif entry["key"] == "lfsFile":
                files[value["path"]] = self.server.lfs[value["oid"]]
        offered = parse_qs(urlsplit(self.path).query).get("create_pr") == ["1"]
        found = self.server.repos[repo]
        number = len(found.pull_requests) + 1
        sha = found.commit(files, f"refs/pr/{number}" if offered else rev)
        answer = {
            "success": True,
            "commitOid": sha,
            "commitUrl": f"{self.server.endpoint}/datasets/{repo}/commit/{sha}",
        }
        if offered:
            found.pull_requests.append(sha)
            answer["pullRequestUrl"] = f"{self.server.endpoint}/{repo}/discussions/{number}"
        self._send(200, answer)

    def _results_of(self, repo: str) -> list[tuple[str, dict, int | None]]:
        """File, entry and pull request of all evaluation results of a model, those on offer among them."""
        found = self.server.repos[repo]
        trees = [(found.refs["main"], None), *((sha, n + 1) for n, sha in enumerate(found.pull_requests))]
        return [
            (name, entry, number)
            for sha, number in trees
            for name, data in found.commits[sha].items()
            if name.startswith(".eval_results/")
            for entry in yaml.safe_load(data)
        ]

    def _leaderboard(self, body, repo):
        if "eval.yaml" not in self.server.repos[repo].commits[self.server.repos[repo].refs["main"]]:
            self._send(404, {"error": "This dataset has no leaderboard"})
            return
        best: dict[str, tuple] = {}
        for model in self.server.repos:
            for name, entry, number in self._results_of(model):
                if entry["dataset"]["id"] == repo:
                    best.setdefault(model, (entry, name, number))
        ranked = sorted(best.items(), key=lambda item: -item[1][0]["value"])
        answer = [
            {
                "rank": rank, "modelId": model, "value": entry["value"], "filename": name, "verified": False,
                "source": entry.get("source"), "author": {"type": "user", "name": "me", "fullname": "Me"},
                "pullRequest": number, "notes": entry.get("notes"),
            }
            for rank, (model, (entry, name, number)) in enumerate(ranked, 1)
        ]  # fmt: skip
        self._send(200, answer)

    def _model(self, body, repo):
        results = [{"filename": name, "data": entry} for name, entry, _ in self._results_of(repo)]
        self._send(200, {"id": repo, "evalResults": results})

    def _tag(self, body, repo, rev):
        refs = self.server.repos[repo].refs
        if self.command == "DELETE":
            self._send(200 if refs.pop(rev, None) else 404, {})
        elif (tag := json.loads(body)["tag"]) in refs:
            self._send(409, {"error": f"Tag {tag} already exists"})
        else:
            refs[tag] = refs.get(rev, rev)
            self._send(200, {})

    def _refs(self, body, repo):
        refs = self.server.repos[repo].refs.items()
        found = {
            kind: [
                {"name": name, "ref": f"refs/{kind}/{name}", "targetCommit": sha}
                for name, sha in refs
                if (name == "main") == (kind == "heads")
            ]
            for kind in ("heads", "tags")
        }
        self._send(200, {"branches": found["heads"], "tags": found["tags"], "converts": []})

    def _info(self, body, repo, rev):
        if sha := self._commit_of(repo, rev):
            files = self.server.repos[repo].commits[sha]
            self._send(200, {"id": repo, "sha": sha, "siblings": [{"rfilename": path} for path in files]})

    def _tree(self, body, repo, rev):
        if sha := self._commit_of(repo, rev):
            self._send(200, [_entry(*item) for item in self.server.repos[repo].commits[sha].items()])

    def _paths_info(self, body, repo, rev):
        if sha := self._commit_of(repo, rev):
            files = self.server.repos[repo].commits[sha]
            wanted = parse_qs(body.decode())["paths"]
            self._send(200, [_entry(path, files[path]) for path in wanted if path in files])

    def _resolve(self, body, repo, rev, file):
        sha = self._commit_of(repo, rev)
        if sha is None:
            return
        data = self.server.repos[repo].commits[sha].get(file)
        if data is None:
            self._refuse(404, "EntryNotFound", "Entry not found")
            return
        headers = {
            "Content-Type": "application/octet-stream",
            "ETag": f'"{hashlib.sha256(data).hexdigest()}"',
            "X-Repo-Commit": sha,
            "Accept-Ranges": "bytes",
        }
        begin = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range") or "")
        start = int(begin[1]) if begin else 0
        if start:
            headers["Content-Range"] = f"bytes {start}-{len(data) - 1}/{len(data)}"
        if file in self.server.cut and self.command == "GET":
            headers["Content-Length"] = str(len(data) - start)
            self._send(206 if start else 200, headers=headers, raw=data[start : len(data) // 2])
            self.close_connection = True
            return
        self._send(206 if start else 200, headers=headers, raw=data[start:])


def _entry(path: str, data: bytes) -> dict:
    entry = {
        "type": "file",
        "path": path,
        "size": len(data),
        "oid": hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest(),
    }
    if path.endswith(".parquet"):
        entry["lfs"] = {"oid": hashlib.sha256(data).hexdigest(), "size": len(data), "pointerSize": 130}
    return entry
