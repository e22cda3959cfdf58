"""A stand-in of the Hugging Face hub: what ``huggingface_hub`` calls to make a repository, to commit, and to take files."""

import base64
import hashlib
import json
import re
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlparse

TOKEN = "hf_only_for_tests"


def sha256(data):
    return hashlib.sha256(data).hexdigest()


class FakeHub:
    """
    Repositories in memory, and the requests that came.

    Zips are large files, which are uploaded apart from the commit, as on the hub.
    """

    def __init__(self):
        #: {repository: {path: content}} of the newest state
        self.repos = {}
        self.private = {}
        self.requests = []
        self.messages = []
        self.objects = {}
        self.endpoint = ""
        self.full = False

    def commit_of(self, repo):
        return hashlib.sha1(repr(sorted((path, sha256(data)) for path, data in self.repos[repo].items())).encode()).hexdigest()


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    hub: FakeHub

    def log_message(self, *_):
        pass

    def answer(self, status, data=None, body=b"", **headers):
        if data is not None:
            body, headers["Content-Type"] = json.dumps(data).encode(), "application/json"
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", headers.get("Content_Length", str(len(body))))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def missing(self, what="RepoNotFound"):
        self.answer(404, {"error": what}, X_Error_Code=what)

    def body(self):
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    @property
    def may_write(self):
        return self.headers.get("Authorization") == f"Bearer {TOKEN}"

    def do_POST(self):
        path, body, hub = unquote(urlparse(self.path).path), self.body(), self.hub
        hub.requests.append(f"POST {path}")
        if path == "/api/validate-yaml":
            return self.answer(200, {"errors": [], "warnings": []})
        if not self.may_write:
            return self.answer(401, {"error": "Invalid username or password."})
        if path == "/api/repos/create":
            asked = json.loads(body)
            repo = f"{asked['organization']}/{asked['name']}"
            url = {"url": f"{hub.endpoint}/{repo}", "name": repo}
            if repo in hub.repos:
                return self.answer(409, {"error": "exists", **url})
            hub.repos[repo], hub.private[repo] = {}, "private" in (asked.get("visibility"), asked.get("private") and "private")
            return self.answer(200, url)
        if match := re.fullmatch(r"/api/models/(.+)/preupload/(.+)", path):
            files = [each["path"] for each in json.loads(body)["files"]]
            modes = [
                {"path": name, "uploadMode": "lfs" if name.endswith(".zip") else "regular", "shouldIgnore": False}
                for name in files
            ]
            return self.answer(200, {"files": modes})
        if match := re.fullmatch(r"/(.+)\.git/info/lfs/objects/batch", path):
            objects = json.loads(body)["objects"]
            for each in objects:
                each["actions"] = {"upload": {"href": f"{hub.endpoint}/lfs/{each['oid']}"}}
            return self.answer(200, {"transfer": "basic", "objects": objects})
        if match := re.fullmatch(r"/api/models/(.+)/commit/(.+)", path):
            if hub.full:
                return self.answer(507, {"error": "No space left"})
            return self.commit(match[1], [json.loads(line) for line in body.splitlines()])
        return self.missing()

    def commit(self, repo, lines):
        for line in lines:
            value = line["value"]
            if line["key"] == "header":
                self.hub.messages.append(value["summary"])
            elif line["key"] == "file":
                self.hub.repos[repo][value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                self.hub.repos[repo][value["path"]] = self.hub.objects[value["oid"]]
        oid = self.hub.commit_of(repo)
        self.answer(200, {"commitUrl": f"{self.hub.endpoint}/{repo}/commit/{oid}", "commitOid": oid, "hookOutput": ""})

    def do_PUT(self):
        body, oid = self.body(), self.path.rpartition("/")[2]
        assert sha256(body) == oid
        self.hub.objects[oid] = body
        self.answer(200)

    def do_GET(self):
        path, hub = unquote(urlparse(self.path).path), self.hub
        hub.requests.append(f"{self.command} {path}")
        match = re.fullmatch(r"/(?:api/models/)?([^/]+/[^/]+)(?:/(revision|tree|resolve)/([^/]+)(?:/(.+))?)?", path)
        if not match or match[1] not in hub.repos or (hub.private[match[1]] and not self.may_write):
            return self.missing()
        repo, kind, revision, name = match.groups()
        files, commit = hub.repos[repo], hub.commit_of(repo)
        if revision not in (None, "main", commit):
            return self.missing("RevisionNotFound")
        if kind == "resolve":
            if name not in files:
                return self.missing("EntryNotFound")
            return self.answer(200, body=files[name], ETag=f'"{sha256(files[name])}"', X_Repo_Commit=commit)
        if kind == "tree":
            return self.answer(200, [self.entry(path, data) for path, data in files.items()])
        siblings = [{"rfilename": path} for path in files]
        return self.answer(
            200, {"id": repo, "modelId": repo, "sha": commit, "siblings": siblings, "tags": [], "private": False}
        )

    do_HEAD = do_GET

    @staticmethod
    def entry(path, data):
        found = {"type": "file", "path": path, "size": len(data), "oid": hashlib.sha1(data).hexdigest()}
        if path.endswith(".zip"):
            found["lfs"] = {"oid": sha256(data), "size": len(data), "pointerSize": 130}
        return found


@contextmanager
def fake_hub():
    """Serve a hub on a free port of this machine."""
    hub = FakeHub()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("OwnHandler", (Handler,), {"hub": hub}))
    hub.endpoint = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
