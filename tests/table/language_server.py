"""A small client of the YAML language server that editors use: LSP over stdio, one request at a time."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, final

import pytest

REPOSITORY = Path(__file__).parents[2]
SERVER = "yaml-language-server"
VERSION = "1.19.2"
SETTINGS = {
    "yaml": {
        "validate": True,
        "hover": True,
        "completion": True,
        "schemaStore": {"enable": False, "url": ""},  # schemas come from the modeline only, not from the network
    }
}


def _installed() -> Path:
    """The server's entry point, installed into the user's cache the first time."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rover-router" / f"{SERVER}-{VERSION}"
    module = cache / "node_modules" / SERVER / "bin" / SERVER
    if not module.exists():
        cache.mkdir(parents=True, exist_ok=True)
        options = ["--prefix", str(cache), "--no-save", "--no-audit", "--no-fund", "--ignore-scripts"]
        subprocess.run(["npm", "install", *options, f"{SERVER}@{VERSION}"], check=True, capture_output=True)  # noqa: S607
    return module


def started() -> Iterator[LanguageServer]:
    """A running server; skips the test where there is no Node.js."""
    if not shutil.which("node") or not shutil.which("npm"):
        pytest.skip("needs node and npm")
    with LanguageServer(_installed(), REPOSITORY) as server:
        yield server


@final
class LanguageServer:
    """The server as a context manager; documents need not exist on disk."""

    def __init__(self, module: Path, root: Path) -> None:
        self._process = subprocess.Popen(
            ["node", str(module), "--stdio"],  # noqa: S607  (whichever node is installed)
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        self._numbers = itertools.count(1)
        self._diagnostics: dict[str, list[dict[str, Any]]] = {}
        capabilities = {
            "workspace": {"configuration": True, "didChangeConfiguration": {"dynamicRegistration": True}},
            "textDocument": {"hover": {"contentFormat": ["markdown"]}, "publishDiagnostics": {}},
        }
        folders = [{"uri": root.as_uri(), "name": "rover"}]
        self.request(
            "initialize",
            {"processId": None, "rootUri": root.as_uri(), "capabilities": capabilities, "workspaceFolders": folders},
        )
        self._notify("initialized", {})
        self._notify("workspace/didChangeConfiguration", {"settings": SETTINGS})

    def __enter__(self) -> LanguageServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()

    def open(self, path: Path, text: str) -> list[dict[str, Any]]:
        """Open a document with this text and return the editor's diagnostics."""
        uri = path.as_uri()
        document = {"uri": uri, "languageId": "yaml", "version": 1, "text": text}
        self._notify("textDocument/didOpen", {"textDocument": document})
        while uri not in self._diagnostics:
            self._take(self._receive())
        return self._diagnostics[uri]

    def hover(self, path: Path, line: int, character: int) -> str:
        """The hover text at a position in an open document; positions count from 0."""
        result = self.request("textDocument/hover", _position(path, line, character))
        return str(result["contents"]["value"]) if result else ""

    def completions(self, path: Path, line: int, character: int) -> set[str]:
        """The editor's completions at a position in an open document."""
        result = self.request("textDocument/completion", _position(path, line, character))
        return {str(item["label"]) for item in result["items"]}

    def request(self, method: str, params: Mapping[str, Any]) -> Any:
        number = next(self._numbers)
        self._send({"id": number, "method": method, "params": params})
        while True:
            message = self._receive()
            if message.get("id") == number and "method" not in message:
                if "error" in message:
                    raise AssertionError(message["error"])
                return message["result"]
            self._take(message)

    def _take(self, message: Mapping[str, Any]) -> None:
        """Handle the server's notifications and requests."""
        if message.get("method") == "textDocument/publishDiagnostics":
            self._diagnostics[message["params"]["uri"]] = message["params"]["diagnostics"]
        elif message.get("method") == "workspace/configuration":
            sections = [item.get("section") for item in message["params"]["items"]]
            self._send({"id": message["id"], "result": [SETTINGS.get(str(section)) for section in sections]})
        elif "id" in message and "method" in message:
            self._send({"id": message["id"], "result": None})

    def _notify(self, method: str, params: Mapping[str, Any]) -> None:
        self._send({"method": method, "params": params})

    def _send(self, message: Mapping[str, Any]) -> None:
        body = json.dumps({"jsonrpc": "2.0", **message}).encode()
        assert self._process.stdin
        self._process.stdin.write(b"Content-Length: %d\r\n\r\n" % len(body) + body)
        self._process.stdin.flush()

    def _receive(self) -> dict[str, Any]:
        stdout, length = self._process.stdout, 0
        assert stdout
        while (header := stdout.readline().strip()) or not length:
            if not header:
                raise AssertionError(f"the language server ended with {self._process.poll()}")
            name, _, value = header.partition(b":")
            if name.lower() == b"content-length":
                length = int(value)
        message: dict[str, Any] = json.loads(stdout.read(length))
        return message


def _position(path: Path, line: int, character: int) -> dict[str, Any]:
    return {"textDocument": {"uri": path.as_uri()}, "position": {"line": line, "character": character}}
