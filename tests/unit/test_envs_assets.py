"""Downloading the YCB meshes, from a server on this machine."""

import contextlib
import gzip
import http.server
import io
import json
import random
import subprocess
import sys
import tarfile
import threading
import time

import pytest
import trimesh

from difflcs_envs import AssetError, MeshError, MissingDependencyError, assets
from difflcs_envs.trifinger.objects import make_object
from difflcs_envs.ycb import YCB
from tests.conftest import refuse

MESH = "004_sugar_box/google_16k/nontextured.stl"
ARCHIVE = "004_sugar_box_google_16k.tgz"


def box_stl(size=(0.176, 0.092, 0.045)) -> bytes:
    return trimesh.creation.box(size).export(file_type="stl")


def archive(files, kind=tarfile.REGTYPE) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size, member.type = len(content), kind
            member.linkname = "/etc/passwd" if kind == tarfile.SYMTYPE else ""
            tar.addfile(member, io.BytesIO(content))
    return buffer.getvalue()


class Server(http.server.BaseHTTPRequestHandler):
    """Serves one archive; can break off connections."""

    content = b""
    cuts: tuple[int, ...] = ()  # bytes after which the next connections break off
    requests = 0
    raw = None  # an answer that is sent as it is

    def do_GET(self):
        cls = type(self)
        cls.requests += 1
        if cls.raw is not None:
            self.wfile.write(cls.raw)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(cls.content)))
        self.end_headers()
        end = len(cls.content)
        if cls.cuts:
            end, cls.cuts = cls.cuts[0], cls.cuts[1:]
        self.wfile.write(cls.content[:end])

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    handler = type("Handler", (Server,), {"content": archive({MESH: box_stl()})})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        threading.Thread(target=running.serve_forever, args=(0.01,), daemon=True).start()
        handler.url = f"http://127.0.0.1:{running.server_port}/{{code}}.tgz"
        yield handler
        running.shutdown()


def fetch(server, folder):
    return assets.download(["sugar_box"], folder, server.url)


def test_download_is_found_and_used(server, tmp_path, monkeypatch):
    monkeypatch.setenv("DIFFLCS_CACHE_DIR", str(tmp_path))
    monkeypatch.delenv(assets.YCB_DIR_VARIABLE, raising=False)
    assert make_object("sugar_box").source == "stand_in"
    lines = []
    assert assets.download(["sugar_box"], None, server.url, lines.append) == [tmp_path / "ycb" / MESH]
    assert "sugar_box" in lines[0]
    assert make_object("sugar_box").source == "ycb_mesh"
    assert make_object("sugar_box", source="stand_in").source == "stand_in"
    assets.download(["sugar_box"], None, server.url)
    assert server.requests == 1  # the archive is there: no second request


def test_an_interrupted_download_is_tried_again(server, tmp_path, monkeypatch):
    server.cuts = (100,)
    assert fetch(server, tmp_path)[0].is_file()
    assert server.requests == 2
    server.cuts = (100, 50)
    monkeypatch.setattr(assets, "ATTEMPTS", 2)
    refuse(AssetError, r"run the command again", fetch, server, tmp_path / "other")
    assert list((tmp_path / "other").iterdir()) == []


def test_changed_archive_is_refused(server, tmp_path, monkeypatch):
    monkeypatch.setattr(assets, "ATTEMPTS", 1)
    fetch(server, tmp_path)
    recorded = json.loads((tmp_path / "sha256.json").read_text())
    assert len(recorded[ARCHIVE]) == 64
    (tmp_path / ARCHIVE).unlink()
    server.content = archive({MESH: box_stl((0.1761, 0.092, 0.045))})
    refuse(AssetError, r"does not match the known hash.*remove", fetch, server, tmp_path)
    assert not (tmp_path / ARCHIVE).exists()
    assert (tmp_path / MESH).is_file()  # the old mesh stays
    assert json.loads((tmp_path / "sha256.json").read_text()) == recorded


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (archive({"../evil.txt": b"x"}), "OutsideDestinationError"),
        (archive({MESH: b""}, tarfile.SYMTYPE), "AbsoluteLinkError"),
        (archive({"004_sugar_box/readme.txt": b"x"}), "found no such mesh"),
        (archive({"004_sugar_box.stl": box_stl()}), "found no such mesh"),
        (archive({MESH: b"solid"}), "is not used"),
        (archive({MESH: box_stl((0.3, 0.1, 0.1))}), r"expected.*45 x 92 x 176 mm.*got 100 x 100 x 300 mm|Expected"),
        (b"not an archive", "is not used"),
        (archive({MESH: box_stl()})[:-40], "is not used"),
        (archive({MESH: box_stl(), "004_sugar_box/zeros": bytes(1 << 21)}), "at most 1 MB unpacked"),
    ],
)
def test_bad_archives_leave_nothing(server, tmp_path, monkeypatch, content, message):
    monkeypatch.setattr(assets, "MAX_UNPACKED", 1 << 20)
    server.content = content
    folder = tmp_path / "deep" / "ycb"
    refuse(AssetError, message, fetch, server, folder)
    assert list(folder.iterdir()) == []
    assert [path.name for path in tmp_path.iterdir()] == ["deep"]


@pytest.mark.parametrize("package", ["filelock", "pooch", "trimesh", "scipy.spatial"])
def test_a_missing_package_is_named(server, tmp_path, monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    refuse(MissingDependencyError, f"need the package '{package}'", fetch, server, tmp_path)


@pytest.mark.parametrize("layout", ["{code}.stl", "{code}/google_16k/nontextured.stl"])
def test_local_folder(tmp_path, monkeypatch, layout):
    monkeypatch.setenv(assets.YCB_DIR_VARIABLE, str(tmp_path))
    refuse(MeshError, r"004_sugar_box.stl.*DIFFLCS_YCB_DIR", make_object, "sugar_box")
    path = tmp_path / layout.format(code=YCB["sugar_box"].code)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(box_stl())
    assert make_object("sugar_box").source == "ycb_mesh"
    path.write_bytes(box_stl((0.3, 0.1, 0.1)))
    refuse(MeshError, "45 x 92 x 176 mm, got 100 x 100 x 300 mm", make_object, "sugar_box")


def test_an_object_that_is_unknown_and_an_address_that_is_no_pattern(tmp_path):
    with pytest.raises(ValueError, match=r"Expected an object out of sugar_box, .*got 'teapot'"):
        assets.download(["teapot"], tmp_path / "new")
    for url in ("http://x/{name}.tgz", "http://x/{}.tgz", "http://x/{code", "{code.x}"):
        refuse(ValueError, r"Expected an address with \{code\}", assets.download, ["sugar_box"], tmp_path / "new", url)
    assert not (tmp_path / "new").exists()


NOWHERE = {
    **dict.fromkeys(["http://127.0.0.1:9/{code}", "nonsense", "http://[/x", "file:///none"], b""),
    "server: missing": b"HTTP/1.1 404 Not Found\r\n\r\n",
    "server: elsewhere": b"HTTP/1.1 302 Found\r\nLocation: http://[\r\n\r\n",
    "server: no number": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    "server: nothing": b"",
}


@pytest.mark.parametrize("url", NOWHERE)
def test_an_address_that_leads_nowhere(server, tmp_path, monkeypatch, url):
    monkeypatch.setattr(assets, "ATTEMPTS", 1)
    server.raw = NOWHERE[url]
    with pytest.raises(AssetError, match="404.*Check the network" if "missing" in url else "Check the network"):
        assets.download(["sugar_box"], tmp_path, server.url if "server" in url else url)
    assert list(tmp_path.iterdir()) == []


# --- archives and records that are made up ----------------------------------------------------------------------------


def test_damaged_archives(server, tmp_path):
    """Damage by a seeded generator, of the compressed stream and of the tar inside it: an error of ours, or a mesh."""
    rng = random.Random(0)
    whole = archive({MESH: box_stl(), "004_sugar_box/readme.txt": b"x" * 600})
    for i in range(60):
        data = bytearray(whole if i % 2 else gzip.decompress(whole))
        for _ in range(rng.choice((1, 3, 30))):
            data[rng.randrange(min(len(data), rng.choice((512, 10_000))))] = rng.randrange(256)
        server.content = bytes(data) if i % 2 else gzip.compress(bytes(data), 1)
        with contextlib.suppress(AssetError):
            fetch(server, tmp_path / str(i))
        assert not list((tmp_path / str(i)).glob(".*"))


@pytest.mark.parametrize(
    "content",
    [b"\xff", b"[]", b"3", b'{"a": 1}', b'[["a", "b"]]', b"[" * 100_000, b'{"a": {}}', b"9" * 5000],
    ids=lambda content: repr(content[:12]),
)  # fmt: skip
def test_recorded_hashes_that_are_none(server, tmp_path, content):
    (tmp_path / "sha256.json").write_bytes(content)
    refuse(AssetError, r"sha256.json: expected recorded checksums.*Delete it", fetch, server, tmp_path)
    assert (tmp_path / "sha256.json").read_bytes() == content
    assert server.requests == 0


def test_a_folder_that_cannot_be_written(server, tmp_path):
    (tmp_path / "file").touch()
    refuse(AssetError, "expected a folder with free space", fetch, server, tmp_path / "file")
    (tmp_path / ARCHIVE).mkdir()
    refuse(AssetError, "expected a folder with free space", fetch, server, tmp_path)


# --- several processes ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_processes_lose_nothing(server, tmp_path):
    """Three at a time, two of which download the same object."""
    names, answer = ("sugar_box", "fish_can", "sugar_box"), server.do_GET
    boxes = {YCB[n].code: archive({f"{YCB[n].code}/google_16k/nontextured.stl": box_stl(YCB[n].size)}) for n in names}

    def do_get(self):
        type(self).content = boxes[self.path[1:].removesuffix(".tgz")]
        time.sleep(0.2)
        answer(self)

    server.do_GET = do_get
    program = "import pathlib, sys; from difflcs_envs import assets; name, folder, url = sys.argv[1:]\n"
    command = [sys.executable, "-c", f"{program}assets.download([name], pathlib.Path(folder), url)"]
    running = [subprocess.Popen([*command, name, str(tmp_path), server.url]) for name in names]
    assert [process.wait(120) for process in running] == [0] * 3
    assert server.requests == 2  # the one that waited has found the archive
    archives = {f"{code}_google_16k.tgz" for code in boxes}
    assert {*json.loads((tmp_path / "sha256.json").read_text())} == archives
    assert {path.name for path in tmp_path.iterdir()} == {*boxes, *archives, "sha256.json"}


@pytest.mark.slow
def test_a_killed_download_is_no_obstacle(server, tmp_path):
    # Killed when the archive is unpacked and its mesh is about to be read.
    program = (
        "import time, trimesh; trimesh.load = lambda *_, **__: time.sleep(60)\nfrom difflcs_envs.assets import *\n"
    )
    program += f"download(['sugar_box'], Path({str(tmp_path)!r}), {server.url!r})"
    with subprocess.Popen([sys.executable, "-c", program]) as killed:
        deadline = time.monotonic() + 30
        while not list(tmp_path.glob(".download-*/004_sugar_box")) and time.monotonic() < deadline:
            time.sleep(0.05)
        killed.kill()
    assert (tmp_path / ".lock").exists()
    assert fetch(server, tmp_path)[0].is_file()
    assert {path.name for path in tmp_path.iterdir()} == {ARCHIVE, "004_sugar_box", "sha256.json"}
