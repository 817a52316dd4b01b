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


@pytest.fixture
def page_port():
    server = HTTPServer(("127.0.0.1", 0), Stub)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server.server_address[1]
    server.shutdown()
    server.server_close()
    thread.join()


def test_the_page_is_passed_on_with_a_policy_and_to_this_machine_only(page_port):
    with guarded_page(page_port, 4321) as port:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connection.request("GET", "/page?x=1")
        answer = connection.getresponse()
        assert (answer.status, answer.read()) == (200, b"<p>viewer</p>")
        assert answer.getheader("Content-Security-Policy") == policy(4321, map_tiles=False)
        connection.close()
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connection.request("GET", "/other")
        assert connection.getresponse().status == 404
        connection.close()
    with pytest.raises(OSError, match="refused"):
        http.client.HTTPConnection("127.0.0.1", port, timeout=1).connect()


def test_the_policy_names_this_machine_alone_unless_tiles_are_asked_for():
    reported = policy(4321, map_tiles=False)
    hosts = {word for word in reported.replace(";", " ").split() if "//" in word}
    assert hosts == {"http://127.0.0.1:4321"}
    assert "https://tile.openstreetmap.org" in policy(4321, map_tiles=True)


def test_the_viewers_program_sends_no_usage_data_and_writes_to_its_folder_only(tmp_path):
    home, folder = tmp_path / "home", tmp_path / "settings"
    home.mkdir()
    folder.mkdir()
    given = {"PATH": "/usr/bin:/bin", "HOME": str(home), "XDG_CONFIG_HOME": str(home / "mine")}
    environment = viewer.silent_environment(folder, given)
    words = viewer.viewer_command("analytics", "config")
    reported = subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stdout
    settings = json.loads(reported)
    assert settings["analytics_enabled"] is False
    assert settings["config_file_path"].startswith(str(folder))
    assert list(home.iterdir()) == []


@pytest.mark.parametrize("spelling", [str.upper, str.lower])
def test_the_viewers_program_reaches_this_machine_alone(tmp_path, spelling):
    given = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "https_proxy": "http://proxy.example"}
    environment = viewer.silent_environment(tmp_path, given)
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        assert urlsplit(environment[spelling(name)]).hostname == "127.0.0.1"
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.1", urlsplit(environment[spelling(name)]).port), timeout=5)
    assert "127.0.0.1" in environment[spelling("no_proxy")].split(",")
    assert viewer.silent_environment(tmp_path, given, offline=False)["https_proxy"] == "http://proxy.example"


def test_without_a_screen_the_other_ways_are_named(injected, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if not has_screen():
        with pytest.raises(OptionError, match=r"--save FILE\.rrd.*--web"):
            show_view([injected])
    assert has_screen({"DISPLAY": ":0"})


def test_without_the_extra_the_command_that_installs_it_is_named(injected, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    stream.sdk.cache_clear()
    try:
        with pytest.raises(MissingExtraError, match=r"pip install 'sceneloom\[view\]'"):
            save_view([injected], tmp_path / "drive.rrd")
    finally:
        stream.sdk.cache_clear()
