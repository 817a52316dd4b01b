"""A store on this machine that speaks as much of S3's protocol as reading needs, and counts what it sends."""

import re
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Self
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

_BLOCK = 1 << 16


class Bucket(ThreadingHTTPServer):
    """Serves the files of a folder by ranges, and lists them.

    Attributes:
        folder: served as the bucket of its name.
        latency: before each answer [s].
        sent: bytes of files that were sent.
        requests: how many came.
    """

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, folder: Path, latency: float = 0.0) -> None:
        super().__init__(("127.0.0.1", 0), _Answers)
        self.folder, self.latency, self.sent, self.requests = folder, latency, 0, 0
        self.count = threading.Lock()
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def address(self) -> str:
        """Where it is, as `https://` sees it and `AWS_ENDPOINT_URL` names it."""
        return f"http://127.0.0.1:{self.server_port}"

    def begin(self) -> None:
        """Count from 0."""
        self.sent = self.requests = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()


class _Answers(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Bucket

    def do_HEAD(self) -> None:
        self._answer(with_content=False)

    def do_GET(self) -> None:
        self._answer(with_content=True)

    def _answer(self, *, with_content: bool) -> None:
        time.sleep(self.server.latency)
        with self.server.count:
            self.server.requests += 1
        parts = urlsplit(self.path)
        asked = parse_qs(parts.query)
        name = unquote(parts.path).lstrip("/").partition("/")[2]
        file = self.server.folder / name
        if "list-type" in asked:
            self._send(
                200, self._listing(asked).encode(), {"Content-Type": "application/xml"}, with_content=with_content
            )
        elif name and file.is_file():
            self._send_file(file, with_content=with_content)
        else:
            self._send(404, b"<Error><Code>NoSuchKey</Code></Error>", {}, with_content=with_content)

    def _listing(self, asked: dict[str, list[str]]) -> str:
        prefix = asked.get("prefix", [""])[0]
        first = asked.get("continuation-token", [""])[0]
        most = int(asked.get("max-keys", ["1000"])[0])
        folder = self.server.folder
        names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
        found = [name for name in names if name.startswith(prefix) and name >= first]
        rows = [_row(name, folder / name) for name in found[:most]]
        more = found[most : most + 1]
        token = f"<NextContinuationToken>{escape(more[0])}</NextContinuationToken>" if more else ""
        return (
            f"<ListBucketResult><IsTruncated>{'true' if more else 'false'}</IsTruncated>{token}"
            f"<KeyCount>{len(rows)}</KeyCount>{''.join(rows)}</ListBucketResult>"
        )

    def _send_file(self, file: Path, *, with_content: bool) -> None:
        size = file.stat().st_size
        wanted = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        start = int(wanted[1]) if wanted else 0
        stop = min(int(wanted[2] or size - 1) + 1, size) if wanted else size
        named = {"Accept-Ranges": "bytes", "ETag": _tag(file), "Last-Modified": "Thu, 01 Jan 2026 00:00:00 GMT"}
        if wanted:
            named["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
        with file.open("rb") as content:
            content.seek(start)
            piece = content.read(stop - start) if with_content else b""
        self._send(206 if wanted else 200, piece, named, with_content=with_content, length=stop - start)

    def _send(
        self, status: int, content: bytes, named: dict[str, str], *, with_content: bool, length: int | None = None
    ) -> None:
        self.send_response(status)
        for name, value in named.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(content) if length is None else length))
        self.end_headers()
        if with_content:
            self._write(content, counts=200 <= status < 300 and "ETag" in named)

    def _write(self, content: bytes, *, counts: bool) -> None:
        for start in range(0, len(content), _BLOCK):
            piece = content[start : start + _BLOCK]
            with self.server.count:
                self.server.sent += len(piece) if counts else 0  # before the client may have it and look
            try:
                self.wfile.write(piece)
            except ConnectionError:  # it has hung up
                self.close_connection = True
                return

    def log_message(self, *_: object) -> None:
        pass


def _tag(file: Path) -> str:
    status = file.stat()
    return f'"{status.st_size:x}-{status.st_mtime_ns:x}"'


def _row(name: str, file: Path) -> str:
    return (
        f"<Contents><Key>{escape(name)}</Key><LastModified>2026-01-01T00:00:00.000Z</LastModified>"
        f"<ETag>{escape(_tag(file))}</ETag><Size>{file.stat().st_size}</Size><StorageClass>STANDARD</StorageClass></Contents>"
    )
