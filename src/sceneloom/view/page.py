"""The viewer's page as it is served to a browser: with a policy that forbids it to talk to anyone else.

Rerun's own page fetches a font, asks whether there is a newer version, and sends usage data from the browser, whatever
the settings on this machine state. Browsers enforce a content security policy, so the page is passed on with one.
"""

import http.client
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

LOOPBACK = "127.0.0.1"
"""Nobody but this machine is answered."""

_TILES = "https://tile.openstreetmap.org https://*.tile.openstreetmap.org"
_PASSED_ON = ("Content-Type", "rerun-final-length")
_PIECE = 1 << 20
_ANSWER_SECONDS = 60.0


def policy(sink_port: int, *, map_tiles: bool) -> str:
    """What the page may fetch: itself, the data of this machine, and map tiles where they are wanted.

    Source: W3C "Content Security Policy Level 3".
    """
    connect = f"'self' http://{LOOPBACK}:{sink_port} data: blob:" + (f" {_TILES}" if map_tiles else "")
    return "; ".join(
        (
            "default-src 'self'",
            "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:",
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "worker-src 'self' blob:",
            f"connect-src {connect}",
            "frame-ancestors 'none'",
            "form-action 'none'",
        )
    )


def _handler(page_port: int, stated: str) -> type[BaseHTTPRequestHandler]:
    class Forwarding(BaseHTTPRequestHandler):
        """Passes requests on to Rerun's own server, and its answers back with the policy."""

        def do_GET(self) -> None:
            upstream = http.client.HTTPConnection(LOOPBACK, page_port, timeout=_ANSWER_SECONDS)
            try:
                upstream.request("GET", self.path)
                answer = upstream.getresponse()
                self._pass_on(answer)
            except (OSError, http.client.HTTPException):
                self.close_connection = True
            finally:
                upstream.close()

        def _pass_on(self, answer: http.client.HTTPResponse) -> None:
            content = answer.read()
            self.send_response(answer.status)
            for name in _PASSED_ON:
                if (value := answer.getheader(name)) is not None:
                    self.send_header(name, value)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Content-Security-Policy", stated)
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            for start in range(0, len(content), _PIECE):
                self.wfile.write(content[start : start + _PIECE])

        def log_message(self, format: str, *arguments: object) -> None:
            """Report nothing: the library does not print."""

    return Forwarding


@contextmanager
def guarded_page(page_port: int, sink_port: int, *, map_tiles: bool = False) -> Iterator[int]:
    """Serve Rerun's page on this machine with the policy; gives the port.

    Args:
        page_port: where Rerun serves it.
        sink_port: where the page gets its data.
        map_tiles: let it fetch tiles of OpenStreetMap.
    """
    server = ThreadingHTTPServer((LOOPBACK, 0), _handler(page_port, policy(sink_port, map_tiles=map_tiles)))
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield int(server.server_address[1])
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
