"""Drives behind signed addresses: read with their secrets, recorded without them, known again when signed anew."""

import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from sceneloom.batch import run
from sceneloom.batch.outputs import record_folder
from sceneloom.batch.record import Record
from sceneloom.batch.running import MetricsFile, read_figures, write_page
from sceneloom.errors import OptionError

QUERY = "X-Amz-Signature={}&X-Amz-Date={}&Expires={}"


@pytest.fixture
def web(tmp_path):
    """A web server over a folder, and the requests to it."""
    asked = []

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            asked.append((self.command, self.path))

    (tmp_path / "web").mkdir()
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(tmp_path / "web")))
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    yield tmp_path / "web", f"http://127.0.0.1:{server.server_port}", asked
    server.shutdown()
    server.server_close()
    thread.join()
    __import__("fsspec").filesystem("http").clear_instance_cache()


def signed(web, name, secret):
    return f"{web[1]}/{name}?{QUERY.format(secret, secret, secret)}"


def test_no_secret_is_kept_or_reported_anywhere(tmp_path, job, inline, web):
    (web[0] / "a.sfs").write_text("one")
    reported, metrics = [], MetricsFile(tmp_path / "run.prom")
    locations = [signed(web, name, "hush") for name in ("a.sfs", "bad.sfs", "odd.sfs", "gone.sfs")]

    def notify(summary, outcome):
        reported.append(repr((summary, outcome)))
        metrics.reported(summary, outcome)

    summary = run(
        job("fetch", locations, options={"truth": locations[0]}, retries=0),
        tmp_path / "out",
        executor=inline(),
        reported=notify,
    )
    assert (summary.done, summary.failed) == (1, 3)
    assert (tmp_path / "out" / "a.txt").read_text() == "one"
    write_page(read_figures(tmp_path / "out"), tmp_path / "run.html")
    with Record.opened(tmp_path / "out") as record:
        reported += [repr((row, record.report(row.number))) for row in record.rows()]
        assert "X-Amz-Signature=***" in record.rows()[0].input
        assert record.report(1)["inner"][0]["reported"].startswith("read http")
    reported += [path.read_bytes().decode("latin-1") for path in tmp_path.rglob("*") if path.is_file()]
    assert len(reported) > 8
    assert not any("hush" in text for text in reported)


def test_drives_are_known_again_when_they_are_signed_anew_and_looked_at_without_reading(
    tmp_path, job, inline, web
):
    for name in ("a.sfs", "b.sfs"):
        (web[0] / name).write_text(name)
    out = tmp_path / "out"
    run(job("fetch", [signed(web, name, "first") for name in ("a.sfs", "b.sfs")]), out, executor=inline())
    (web[0] / "b.sfs").write_text("other content")
    web[2].clear()
    executor = inline()
    again = [signed(web, name, "second") for name in ("a.sfs", "b.sfs")]
    summary = run(job("fetch", again), out, executor=executor, resume=True)
    assert (summary.skipped, summary.done) == (1, 2)
    assert [task.location for task in executor.tasks] == again[1:]
    assert {command for command, path in web[2] if path.startswith("/a.sfs")} == {"HEAD"}
    assert (out / "b.txt").read_text() == "other content"


def test_drives_that_only_secrets_distinguish_are_refused(tmp_path, job, inline, web):
    locations = [signed(web, "a.sfs", secret) for secret in ("one", "two")]
    with pytest.raises(OptionError, match="differ in secrets only") as caught:
        run(job("fetch", locations), tmp_path / "out", executor=inline())
    assert "one" not in str(caught.value).replace("done", "")


def test_the_folder_of_a_record_has_no_secret_in_its_name():
    assert record_folder("s3://me:hush@bucket/x?token=hush") == record_folder(
        "s3://me:other@bucket/x?token=new"
    )
    assert "hush" not in str(record_folder("s3://bucket/x?token=hush"))
