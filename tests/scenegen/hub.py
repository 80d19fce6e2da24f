"""A stand-in for the Hugging Face Hub: its HTTP API, as far as datasets are published and
downloaded, in a thread."""

import base64
import hashlib
import json
import re
import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

TOKEN = "hf_thisIsNotARealTokenButASecret"
LARGE = (".h5", ".zip", ".png")
"""Endings of files that go as large ones."""


@dataclass
class Repository:
    private: bool = False
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    head: str = ""
    tags: dict[str, str] = field(default_factory=dict)

    def files(self, revision):
        return self.commits.get(self.sha(revision))

    def sha(self, revision):
        return self.head if revision in (None, "main") else self.tags.get(revision, revision)

    def commit(self, files):
        self.head = hashlib.sha1(repr([self.head, sorted(files.items())]).encode()).hexdigest()
        self.commits[self.head] = dict(files)
        return self.head


class Hub:
    """The server. `log` holds "METHOD path" of every request, `puts` the content that arrived, in
    order."""

    def __init__(self):
        self.repositories = {}
        self.blobs = {}
        self.log = []
        self.tokens = set()
        self.puts = []
        self.refuse_after = None
        """Large files after which the next ones are refused."""
        self.lose = None
        """A file that is dropped from commits."""
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
        self._server.hub = self
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()

    @property
    def tags(self):
        """Of the one repository."""
        (one,) = self.repositories.values()
        return one.tags

    def close(self):
        self._server.shutdown()
        self._server.server_close()


class Refused(Exception):  # noqa: N818
    """A status, a message, and the Hub's code for it, if there is one."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *args):
        pass

    def _answer(self, content, status=200, **headers):
        sent = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in {"Content-Type": "application/json", **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(sent)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(sent)

    def _handle(self):
        try:
            self._route(unquote(urlsplit(self.path).path))
        except Refused as refused:
            status, message, *code = refused.args
            headers = {"X_Error_Code": code[0], "X_Error_Message": message} if code else {}
            self._answer({"error": message}, status, **headers)

    def _route(self, path):
        hub = self.server.hub
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        hub.log.append(f"{self.command} {path}")
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        if token:
            hub.tokens.add(token)
        if self.command in ("POST", "PUT") and not path.startswith("/lfs/") and token != TOKEN:
            raise Refused(401, "Invalid username or password.")
        for method, pattern, handler in ROUTES:
            match = re.fullmatch(pattern, path)
            if match and self.command in method:
                return handler(self, hub, body, *match.groups())
        raise Refused(404, f"no such page: {path}")

    do_GET = do_POST = do_PUT = do_HEAD = _handle  # noqa: N815


def create(page, hub, body):
    fields = json.loads(body)
    name = f"{fields['organization']}/{fields['name']}"
    is_there = name in hub.repositories
    if not is_there:
        private = "private" in (fields.get("visibility"), fields.get("private") and "private")
        hub.repositories[name] = Repository(private=private)
        hub.repositories[name].commit({".gitattributes": b"*.h5 filter=lfs\n"})
    page._answer({"url": f"{hub.url}/datasets/{name}", "id": name}, 409 if is_there else 200)


def _known(hub, name, revision="main"):
    if name not in hub.repositories:
        raise Refused(404, "Repository not found", "RepoNotFound")
    files = hub.repositories[name].files(revision)
    if files is None:
        raise Refused(404, f"Invalid rev id: {revision}", "RevisionNotFound")
    return files


def _entry(path, content):
    blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
    entry = {"type": "file", "path": path, "size": len(content), "oid": blob}
    if path.endswith(LARGE):
        oid = hashlib.sha256(content).hexdigest()
        entry["lfs"] = {"oid": oid, "size": len(content), "pointerSize": 134}
    return entry


def info(page, hub, body, name, revision=None):
    files = _known(hub, name, revision or "main")
    repository = hub.repositories[name]
    facts = {"id": name, "sha": repository.sha(revision), "private": repository.private}
    siblings = [{"rfilename": path, "size": len(content)} for path, content in files.items()]
    page._answer(facts | {"siblings": siblings, "tags": []})


def tree(page, hub, body, name, revision):
    files = _known(hub, name, revision)
    page._answer([_entry(path, content) for path, content in files.items()])


def refs(page, hub, body, name):
    _known(hub, name)
    repository = hub.repositories[name]
    tags = [
        {"name": tag, "ref": f"refs/tags/{tag}", "targetCommit": sha}
        for tag, sha in repository.tags.items()
    ]
    main = {"name": "main", "ref": "refs/heads/main", "targetCommit": repository.head}
    page._answer({"branches": [main], "converts": [], "tags": tags})


def preupload(page, hub, body, name, revision):
    files_there = _known(hub, name, revision)
    answers = []
    for path in [file["path"] for file in json.loads(body)["files"]]:
        entry = _entry(path, files_there[path]) if path in files_there else {}
        mode = "lfs" if path.endswith(LARGE) else "regular"
        oid = entry.get("lfs", entry).get("oid")
        answers.append({"path": path, "uploadMode": mode, "shouldIgnore": False, "oid": oid})
    page._answer({"files": answers})


def batch(page, hub, body, name):
    objects = json.loads(body)["objects"]
    for file in objects:
        if file["oid"] not in hub.blobs:
            file["actions"] = {"upload": {"href": f"{hub.url}/lfs/{file['oid']}"}}
    page._answer({"transfer": "basic", "objects": objects})


def put(page, hub, body, oid):
    if hub.refuse_after is not None and len(hub.puts) >= hub.refuse_after:
        raise Refused(400, "the connection broke")
    assert hashlib.sha256(body).hexdigest() == oid
    hub.blobs[oid] = body
    hub.puts.append(oid)
    page._answer({})


def commit(page, hub, body, name, revision):
    files = dict(_known(hub, name, revision))
    for line in body.splitlines():
        key, value = json.loads(line).values()
        if key == "header" and value["parentCommit"] != hub.repositories[name].head:
            raise Refused(412, "a commit has happened since")
        if key == "file":
            files[value["path"]] = base64.b64decode(value["content"])
        elif key == "lfsFile":
            files[value["path"]] = hub.blobs[value["oid"]]
        elif key == "deletedFile":
            del files[value["path"]]
    files.pop(hub.lose, None)
    sha = hub.repositories[name].commit(files)
    page._answer(
        {"success": True, "commitOid": sha, "commitUrl": f"{hub.url}/datasets/{name}/commit/{sha}"}
    )


def tag(page, hub, body, name, revision):
    repository = hub.repositories[name]
    name_of_tag = json.loads(body)["tag"]
    if name_of_tag in repository.tags:
        raise Refused(409, "tag is there")
    repository.tags[name_of_tag] = repository.sha(revision)
    page._answer({})


def resolve(page, hub, body, name, revision, path):
    files = _known(hub, name, revision)
    if path not in files:
        raise Refused(404, "Entry not found", "EntryNotFound")
    entry = _entry(path, files[path])
    etag = entry.get("lfs", entry)["oid"]
    sha, size = hub.repositories[name].sha(revision), str(len(files[path]))
    page._answer(files[path], ETag=f'"{etag}"', X_Repo_Commit=sha, X_Linked_Size=size)


def validate_yaml(page, hub, body):
    assert json.loads(body)["content"].startswith("---\n")
    page._answer({"errors": [], "warnings": []})


NAME, REVISION = r"([^/]+/[^/]+)", r"([^/]+)"
ROUTES = (
    ("POST", r"/api/repos/create", create),
    ("POST", r"/api/validate-yaml", validate_yaml),
    ("GET", rf"/api/datasets/{NAME}", info),
    ("GET", rf"/api/datasets/{NAME}/revision/{REVISION}", info),
    ("GET", rf"/api/datasets/{NAME}/refs", refs),
    ("GET", rf"/api/datasets/{NAME}/tree/{REVISION}", tree),
    ("POST", rf"/api/datasets/{NAME}/preupload/{REVISION}", preupload),
    ("POST", rf"/datasets/{NAME}\.git/info/lfs/objects/batch", batch),
    ("PUT", r"/lfs/([0-9a-f]{64})", put),
    ("POST", rf"/api/datasets/{NAME}/commit/{REVISION}", commit),
    ("POST", rf"/api/datasets/{NAME}/tag/{REVISION}", tag),
    ("GET HEAD", rf"/datasets/{NAME}/resolve/{REVISION}/(.+)", resolve),
)
