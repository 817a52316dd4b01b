"""The viewer's program and page, kept on this machine; what is stated where there is no viewer."""

import http.client
import json
import socket
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from urllib.parse import urlsplit

import pytest

from sceneloom.errors import MissingExtraError, OptionError
from sceneloom.view import save_view, show_view, stream, viewer
from sceneloom.view.viewer import guarded_page, has_screen, policy


class Stub(BaseHTTPRequestHandler):
    """Stands for the server of Rerun's page."""

    def do_GET(self):
        self.send_response(200 if self.path == "/page?x=1" else 404)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<p>viewer</p>")

    def log_message(self, format, *arguments):
        """Report nothing."""


def test_the_page_is_passed_on_with_a_policy_and_to_this_machine_only():
    server = HTTPServer(("127.0.0.1", 0), Stub)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    with guarded_page(server.server_address[1], 4321) as port:
        for path, status, content in (("/page?x=1", 200, b"<p>viewer</p>"), ("/other", 404, b"<p>viewer</p>")):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
            connection.request("GET", path)
            answer = connection.getresponse()
            assert (answer.status, answer.read()) == (status, content)
            assert answer.getheader("Content-Security-Policy") == policy(4321, map_tiles=False)
            connection.close()
    server.shutdown()
    server.server_close()
    thread.join()
    with pytest.raises(OSError, match="refused"):
        http.client.HTTPConnection("127.0.0.1", port, timeout=1).connect()
    hosts = {word for word in policy(4321, map_tiles=False).replace(";", " ").split() if "//" in word}
    assert hosts == {"http://127.0.0.1:4321"}
    assert "https://tile.openstreetmap.org" in policy(4321, map_tiles=True)


def test_the_viewers_program_sends_no_usage_data_writes_to_its_folder_and_reaches_this_machine_alone(tmp_path):
    home, folder = tmp_path / "home", tmp_path / "settings"
    home.mkdir()
    folder.mkdir()
    given = {"PATH": "/usr/bin:/bin", "HOME": str(home), "XDG_CONFIG_HOME": str(home / "mine")}
    given["https_proxy"] = "http://proxy.example"
    environment = viewer.silent_environment(folder, given)
    words = viewer.viewer_command("analytics", "config")
    settings = json.loads(subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stdout)
    assert settings["analytics_enabled"] is False
    assert settings["config_file_path"].startswith(str(folder))
    assert list(home.iterdir()) == []
    for name in ("http_proxy", "https_proxy", "all_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        assert urlsplit(environment[name]).hostname == "127.0.0.1"
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.1", urlsplit(environment[name]).port), timeout=5)
    for name in ("no_proxy", "NO_PROXY"):
        assert "127.0.0.1" in environment[name].split(",")
    assert viewer.silent_environment(folder, given, offline=False)["https_proxy"] == "http://proxy.example"


def test_without_a_screen_or_the_extra_what_to_do_is_named(injected, monkeypatch, tmp_path):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if not has_screen():
        with pytest.raises(OptionError, match=r"--save FILE\.rrd.*--web"):
            show_view([injected])
    assert has_screen({"DISPLAY": ":0"})
    monkeypatch.setitem(sys.modules, "rerun", None)
    stream.sdk.cache_clear()
    try:
        with pytest.raises(MissingExtraError, match=r"pip install 'sceneloom\[view\]'"):
            save_view([injected], tmp_path / "drive.rrd")
    finally:
        stream.sdk.cache_clear()
