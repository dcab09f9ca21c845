"""Downloading the YCB meshes, from a server on this machine."""

import http.server
import io
import json
import tarfile
import threading

import pytest

trimesh = pytest.importorskip("trimesh", reason="the environments need the extra [envs]")
pytest.importorskip("mujoco", reason="the environments need the extra [envs]")

from difflcs_envs import AssetError, MeshError, assets  # noqa: E402
from difflcs_envs.trifinger.objects import make_object  # noqa: E402
from difflcs_envs.ycb import YCB  # noqa: E402

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
            if kind == tarfile.SYMTYPE:
                member.size, member.linkname = 0, "/etc/passwd"
            tar.addfile(member, io.BytesIO(content))
    return buffer.getvalue()


class Server(http.server.BaseHTTPRequestHandler):
    """Serves one archive with byte ranges; can break off connections."""

    content = b""
    cuts: tuple[int, ...] = ()  # bytes after which the next connections break off
    ranges: tuple[str, ...] = ()  # what was asked for
    status = 200

    def do_GET(self):
        cls = type(self)
        wanted = self.headers.get("Range", "")
        cls.ranges += (wanted,)
        if cls.status != 200:
            self.send_error(cls.status)
            return
        start = int(wanted.removeprefix("bytes=").rstrip("-") or 0)
        if start >= len(cls.content):
            self.send_error(416)
            return
        self.send_response(206 if wanted else 200)
        if wanted:
            self.send_header("Content-Range", f"bytes {start}-{len(cls.content) - 1}/{len(cls.content)}")
        self.send_header("Content-Length", str(len(cls.content) - start))
        self.end_headers()
        end = len(cls.content)
        if cls.cuts:
            end, cls.cuts = start + cls.cuts[0], cls.cuts[1:]
        self.wfile.write(cls.content[start:end])

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    handler = type("Handler", (Server,), {"content": archive({MESH: box_stl()})})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
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
    assert len(server.ranges) == 1  # the archive is there: no second request


def test_interrupted_download_goes_on_where_it_stopped(server, tmp_path):
    server.cuts = (100, 50, 30)
    with pytest.raises(AssetError, match=r"run the command again"):
        fetch(server, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [ARCHIVE + ".part"]
    assert fetch(server, tmp_path)[0].is_file()
    assert server.ranges == ("", "bytes=100-", "bytes=150-", "bytes=180-")
    assert not (tmp_path / (ARCHIVE + ".part")).exists()


def test_leftover_longer_than_the_file_is_dropped(server, tmp_path):
    (tmp_path / (ARCHIVE + ".part")).write_bytes(b"x" * 10**5)
    assert fetch(server, tmp_path)[0].is_file()
    assert server.ranges == ("bytes=100000-", "")


def test_changed_archive_is_refused(server, tmp_path):
    fetch(server, tmp_path)
    recorded = json.loads((tmp_path / "sha256.json").read_text())
    assert len(recorded[ARCHIVE]) == 64
    (tmp_path / ARCHIVE).unlink()
    server.content = archive({MESH: box_stl((0.1761, 0.092, 0.045))})
    with pytest.raises(AssetError, match="has changed: expected SHA-256"):
        fetch(server, tmp_path)
    assert not (tmp_path / ARCHIVE).exists()
    assert (tmp_path / MESH).is_file()  # the old mesh stays
    assert json.loads((tmp_path / "sha256.json").read_text()) == recorded


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (archive({"../evil.txt": b"x"}), "leave its folder"),
        (archive({"/tmp/evil.txt": b"x"}), "leave its folder"),
        (archive({MESH: b""}, tarfile.SYMTYPE), "no plain file"),
        (archive({"004_sugar_box/readme.txt": b"x"}), "found no mesh"),
        (archive({"007_other/nontextured.stl": b"x"}), "expected a folder 004_sugar_box"),
        (archive({MESH: b"solid"}), "is not used"),
        (archive({MESH: box_stl((0.3, 0.1, 0.1))}), r"expected.*45 x 92 x 176 mm.*got 100 x 100 x 300 mm|Expected"),
        (b"not an archive", "cannot be unpacked"),
        (archive({MESH: box_stl()})[:-40], "cannot be unpacked"),
    ],
)
def test_bad_archives_leave_nothing(server, tmp_path, content, message):
    server.content = content
    folder = tmp_path / "deep" / "ycb"
    with pytest.raises(AssetError, match=message):
        fetch(server, folder)
    assert list(folder.iterdir()) == []
    assert [path.name for path in tmp_path.iterdir()] == ["deep"]


def test_missing_archive(server, tmp_path):
    server.status = 404
    with pytest.raises(AssetError, match="404"):
        fetch(server, tmp_path)
    with pytest.raises(ValueError, match=r"Expected an object out of sugar_box, .*got 'teapot'"):
        assets.download(["teapot"], tmp_path, server.url)


def test_no_server(tmp_path):
    with pytest.raises(AssetError, match="Check the network"):
        assets.download(["sugar_box"], tmp_path, "http://127.0.0.1:9/{code}.tgz")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("layout", ["{code}.stl", "{code}/google_16k/nontextured.stl"])
def test_local_folder(tmp_path, monkeypatch, layout):
    monkeypatch.setenv(assets.YCB_DIR_VARIABLE, str(tmp_path))
    with pytest.raises(MeshError, match=r"004_sugar_box.stl.*DIFFLCS_YCB_DIR"):
        make_object("sugar_box")
    path = tmp_path / layout.format(code=YCB["sugar_box"].code)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(box_stl())
    assert make_object("sugar_box").source == "ycb_mesh"
    path.write_bytes(box_stl((0.3, 0.1, 0.1)))
    with pytest.raises(MeshError, match="45 x 92 x 176 mm, got 100 x 100 x 300 mm"):
        make_object("sugar_box")
