"""The YCB meshes on this machine: find them, or download them from the YCB site. Standard library only.

The archives are kept whole: their SHA-256 is recorded at the first download and every later download must match it.
Nothing is ever half there. Archives grow in `NAME.part`, from where an interrupted download goes on, and are unpacked
into a hidden folder that gets its name in one step.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tarfile
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable
from pathlib import Path, PurePosixPath

from difflcs_envs.errors import AssetError, MeshError
from difflcs_envs.ycb import YCB, YcbObject

__all__ = ["YCB_DIR_VARIABLE", "YCB_URL", "download", "find_ycb_mesh", "ycb_download_directory"]

YCB_URL = "https://ycb-benchmarks.s3.amazonaws.com/data/google/{code}_google_16k.tgz"
YCB_DIR_VARIABLE = "DIFFLCS_YCB_DIR"
TIMEOUT = 30.0  # [s]
CHUNK = 1 << 16  # [byte]
MAX_UNPACKED = 1 << 30  # [byte]
ATTEMPTS = 3

# Where the mesh of an object may lie below a folder, best first.
_LAYOUTS = (
    "{code}.stl",
    "{code}.obj",
    "{code}.ply",
    "{code}/google_16k/nontextured.stl",
    "{code}/google_16k/nontextured.ply",
    "{code}/google_16k/textured.obj",
    "{code}/nontextured.stl",
    "{code}/textured.obj",
)


def ycb_download_directory() -> Path:
    """Where `download` puts the objects."""
    from difflcs_envs.trifinger.meshes import cache_directory

    return cache_directory() / "ycb"


def find_ycb_mesh(entry: YcbObject) -> Path | None:
    """The mesh of an object; None if it is not on this machine.

    Raises:
        MeshError: `DIFFLCS_YCB_DIR` is set, but the mesh is not there.
    """
    chosen = os.environ.get(YCB_DIR_VARIABLE)
    folder = Path(chosen) if chosen else ycb_download_directory()
    path = _mesh_below(folder, entry)
    if path is not None or not chosen:
        return path
    raise MeshError(
        f"Expected {entry.code}.stl or {entry.code}/google_16k/nontextured.stl in {YCB_DIR_VARIABLE}={chosen}, found "
        f"neither. Put it there, or unset {YCB_DIR_VARIABLE} to use downloaded meshes and stand-ins."
    )


def _mesh_below(folder: Path, entry: YcbObject) -> Path | None:
    paths = (folder / layout.format(code=entry.code) for layout in _LAYOUTS)
    return next((path for path in paths if path.is_file()), None)


def download(
    names: Iterable[str] | None = None,
    folder: Path | None = None,
    url: str = YCB_URL,
    report: Callable[[str], object] = lambda line: None,
) -> list[Path]:
    """Download YCB objects, check them, unpack them.

    Args:
        names: Objects, by our names; None for all.
        folder: Where to; None for where the environments look.
        url: Address with `{code}` for the object's name in the YCB set.
        report: Called with a line of text for every object.

    Returns:
        The mesh of each object.

    Raises:
        AssetError: The download failed or is not what it should be. What was there before stays there.
        ValueError: An object is unknown.
    """
    names = list(YCB if names is None else names)
    for name in names:
        if name not in YCB:
            raise ValueError(f"Expected an object out of {', '.join(YCB)}, got {name!r}. Choose one of them.")
    folder = ycb_download_directory() if folder is None else folder
    return [_download_object(YCB[name], folder, url, report) for name in names]


def _download_object(entry: YcbObject, folder: Path, url: str, report: Callable[[str], object]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    archive = folder / f"{entry.code}_google_16k.tgz"
    address = url.format(code=entry.code)
    if not archive.exists():
        _fetch(address, archive)
    digest = _sha256(archive)
    known = _known_hashes(folder)
    if known.setdefault(archive.name, digest) != digest:
        archive.unlink()
        raise AssetError(
            f"{address} has changed: expected SHA-256 {known[archive.name]}, as recorded at the first download, got "
            f"{digest}. If you trust the new file, remove {archive.name} from {folder / 'sha256.json'} and try again."
        )
    try:
        mesh = _unpack(archive, folder, entry)
    except AssetError:
        archive.unlink(missing_ok=True)
        raise
    _write_json(folder / "sha256.json", known)
    report(f"{entry.name}: {mesh} (sha256 {digest[:12]}...)")
    return mesh


def _fetch(address: str, archive: Path) -> None:
    """Download into `archive`, going on where an earlier attempt was cut off."""
    part = archive.with_name(archive.name + ".part")
    for attempt in range(ATTEMPTS):
        try:
            complete = _fetch_rest(address, part)
        except (OSError, urllib.error.URLError) as error:  # HTTPError is a URLError
            if isinstance(error, urllib.error.HTTPError) and error.code == 416:  # no such range: not our file
                part.unlink(missing_ok=True)
            elif isinstance(error, urllib.error.HTTPError) and error.code < 500:
                raise AssetError(
                    f"{address}: expected an archive, got the answer {error.code} {error.reason}. Look at the address; "
                    f"with meshes from elsewhere let {YCB_DIR_VARIABLE} name their folder."
                ) from error
            complete, reason = False, str(error)
        else:
            reason = "the connection ended early"
        if complete:
            os.replace(part, archive)
            return
        if attempt + 1 == ATTEMPTS:
            raise AssetError(
                f"{address} could not be downloaded: {reason}. Check the network and run the command again; it goes on "
                f"where it stopped."
            )


def _fetch_rest(address: str, part: Path) -> bool:
    """One request for what is missing. Returns whether the file is complete."""
    have = part.stat().st_size if part.exists() else 0
    request = urllib.request.Request(address, headers={"Range": f"bytes={have}-"} if have else {})
    with urllib.request.urlopen(request, timeout=TIMEOUT) as answer:
        start = 0
        if answer.status == 206:
            start = int(answer.headers.get("Content-Range", "bytes 0-").split()[1].split("-")[0])
        length = answer.headers.get("Content-Length")
        total = None if length is None else start + int(length)
        with part.open("r+b" if start else "wb") as file:
            file.seek(start)
            file.truncate()
            while chunk := answer.read(CHUNK):
                file.write(chunk)
            size = file.tell()
    return total is None or size == total


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def _known_hashes(folder: Path) -> dict[str, str]:
    path = folder / "sha256.json"
    try:
        return dict(json.loads(path.read_text()))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError) as error:
        raise AssetError(
            f"{path}: expected recorded checksums, cannot read them ({error}). Delete the file."
        ) from error


def _unpack(archive: Path, folder: Path, entry: YcbObject) -> Path:
    """Unpack into `folder/code` and return the mesh. Only plain files and folders below it are accepted."""
    temporary = Path(tempfile.mkdtemp(dir=folder, prefix=f".{entry.code}."))
    try:
        with tarfile.open(archive, "r:gz") as tar:
            members = tar.getmembers()
            for member in members:
                parts = PurePosixPath(member.name).parts
                if ".." in parts or member.name.startswith("/") or not (member.isfile() or member.isdir()):
                    raise AssetError(
                        f"{archive.name} holds {member.name!r}, which would leave its folder or is no plain file. The "
                        "archive is not used; report it to where it came from."
                    )
            if sum(member.size for member in members) > MAX_UNPACKED:
                raise AssetError(f"{archive.name}: expected less than {MAX_UNPACKED >> 20} MB unpacked, got more.")
            tar.extractall(temporary, members, filter="data")
        unpacked = temporary / entry.code
        if not unpacked.is_dir():
            raise AssetError(f"{archive.name}: expected a folder {entry.code}, got {sorted(os.listdir(temporary))}.")
        mesh = _mesh_below(temporary, entry)
        if mesh is None:
            raise AssetError(f"{archive.name}: expected {entry.code}/google_16k/nontextured.stl in it, found no mesh.")
        _check(mesh, entry)
        shutil.rmtree(folder / entry.code, ignore_errors=True)
        os.replace(unpacked, folder / entry.code)
    except (tarfile.TarError, EOFError, OSError, ValueError) as error:
        raise AssetError(f"{archive.name} cannot be unpacked ({error}). Run the command again.") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return folder / mesh.relative_to(temporary)


def _check(mesh: Path, entry: YcbObject) -> None:
    """Compare the size of what was downloaded with the table."""
    from difflcs_envs.trifinger.meshes import check_extent, load_mesh

    try:
        check_extent(load_mesh(mesh), entry.name, entry.size, mesh)
    except MeshError as error:
        raise AssetError(f"The download of {entry.name} is not used: {error}") from error


def _write_json(path: Path, content: dict[str, str]) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")
    os.replace(temporary, path)
