"""The YCB meshes on this machine: find them, or download them from the YCB site.

The archives are kept whole: their SHA-256 is recorded at the first download and every later download must match it.
No file is ever incomplete under its name: archives grow in `NAME.part`, and are unpacked into a hidden folder that is
renamed in one step. One process at a time works in a folder; the others wait. The size of answers and archives is
limited; beyond that they raise an `AssetError`.
"""

import contextlib
import gzip
import hashlib
import http.client
import json
import os
import re
import shutil
import tarfile
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from difflcs_envs.errors import AssetError, MeshError, MissingDependencyError
from difflcs_envs.ycb import YCB, YcbObject

YCB_URL = "https://ycb-benchmarks.s3.amazonaws.com/data/google/{code}_google_16k.tgz"
YCB_DIR_VARIABLE = "DIFFLCS_YCB_DIR"
TIMEOUT = 30.0  # [s] without a byte
MAX_SECONDS = 3600.0  # [s] of one request: a server that drips would keep us for days
CHUNK = 1 << 16  # [byte]
MAX_ARCHIVE = 1 << 28  # [byte]; the largest of these objects has 1 << 25
MAX_UNPACKED = 1 << 29  # [byte]
MAX_MEMBERS = 1000  # files and folders in an archive
MAX_RECORDS = 1 << 20  # [byte] of sha256.json
ATTEMPTS = 3
LOCK = ".lock"

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
    """Return the folder into which `download` puts the objects."""
    from difflcs_envs.trifinger.meshes import cache_directory

    return cache_directory() / "ycb"


def find_ycb_mesh(entry: YcbObject) -> Path | None:
    """Find the mesh of an object; None if it is not on this machine.

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
        AssetError: The download failed or has unexpected content. Earlier files stay.
        ValueError: An object is unknown.
    """
    names = list(YCB if names is None else names)
    for name in names:
        if name not in YCB:
            raise ValueError(f"Expected an object out of {', '.join(YCB)}, got {name!r}. Choose one of them.")
    addresses = [_address(url, YCB[name]) for name in names]
    folder = ycb_download_directory() if folder is None else folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder, report):
            entries = zip(names, addresses, strict=True)
            return [_download_object(YCB[name], folder, address, report) for name, address in entries]
    except OSError as error:
        raise AssetError(
            f"{folder}: expected a folder with free space that can be written, got: {error}. Mend that, or choose "
            f"another folder."
        ) from error


def _address(url: str, entry: YcbObject) -> str:
    try:
        return url.format(code=entry.code)
    except (LookupError, ValueError, AttributeError) as error:
        raise ValueError(
            f"Expected an address with {{code}} for the object's name, got {url!r} ({error}). Correct it."
        ) from error


@contextlib.contextmanager
def _locked(folder: Path, report: Callable[[str], object]) -> Iterator[None]:
    """Wait until no other process downloads into a folder. The system ends the lock with its process."""
    try:
        import filelock
    except ImportError as error:
        raise MissingDependencyError("filelock") from error
    path = folder / LOCK
    lock = filelock.FileLock(path)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout:
        report(f"another process downloads into {folder}: waiting for it")
        lock.acquire()
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink()  # before the release: who has opened it already sees that it is gone, and tries again
        lock.release()


def _download_object(entry: YcbObject, folder: Path, address: str, report: Callable[[str], object]) -> Path:
    archive = folder / f"{entry.code}_google_16k.tgz"
    known = _known_hashes(folder)
    if not archive.exists():
        _fetch(address, archive)
    digest = _sha256(archive)
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
    """Download into `archive`."""
    part = archive.with_name(archive.name + ".part")
    for _ in range(ATTEMPTS):
        try:
            complete, reason = _fetch_once(address, part), "the connection ended early"
        except (OSError, http.client.HTTPException, ValueError, LookupError) as error:  # HTTPError is an OSError
            if isinstance(error, urllib.error.HTTPError) and error.code < 500:
                raise AssetError(
                    f"{address}: expected an archive, got the answer {error.code} {error.reason}. Look at the address; "
                    f"with meshes from elsewhere let {YCB_DIR_VARIABLE} name their folder."
                ) from error
            complete, reason = False, f"{type(error).__name__}: {error}"
        if complete:
            os.replace(part, archive)
            return
    part.unlink(missing_ok=True)
    raise AssetError(f"{address} could not be downloaded: {reason}. Check the network and run the command again.")


def _fetch_once(address: str, part: Path) -> bool:
    """Request the file once. Return True if it is complete."""
    with urllib.request.urlopen(address, timeout=TIMEOUT) as answer, part.open("wb") as file:
        length = answer.headers.get("Content-Length")
        total = None if length is None else int(length)
        _check_size(address, part, total or 0)
        deadline = time.monotonic() + MAX_SECONDS
        while chunk := answer.read1(CHUNK):  # what is there, so that a server that drips is noticed
            file.write(chunk)
            _check_size(address, part, file.tell())
            if time.monotonic() > deadline:
                raise TimeoutError(f"still going on after {MAX_SECONDS:g} s")
        size = file.tell()
    return total is None or size == total


def _check_size(address: str, part: Path, size: int) -> None:
    if size > MAX_ARCHIVE:
        part.unlink(missing_ok=True)
        raise AssetError(
            f"{address}: expected an archive of at most {MAX_ARCHIVE >> 20} MB, got {size >> 20} MB or more. Look at "
            f"the address; with meshes from elsewhere let {YCB_DIR_VARIABLE} name their folder."
        )


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def _known_hashes(folder: Path) -> dict[str, str]:
    path = folder / "sha256.json"
    try:
        with path.open("rb") as file:
            text = file.read(MAX_RECORDS + 1)
        if len(text) > MAX_RECORDS:
            raise ValueError(f"more than {MAX_RECORDS >> 20} MB")
        known = json.loads(text)
        if not isinstance(known, dict) or not all(isinstance(v, str) and _HASH.fullmatch(v) for v in known.values()):
            raise ValueError("something else")
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise AssetError(
            f"{path}: expected recorded checksums, cannot read them ({error}). Delete the file."
        ) from error
    return known


_HASH = re.compile("[0-9a-f]{64}")


def _unpack(archive: Path, folder: Path, entry: YcbObject) -> Path:
    """Unpack into `folder/code` and return the mesh. Only plain files and folders below it are accepted."""
    for leftover in folder.glob(f".{entry.code}.*"):  # of a process that was killed: the folder is ours
        shutil.rmtree(leftover, ignore_errors=True)
    temporary = Path(tempfile.mkdtemp(dir=folder, prefix=f".{entry.code}."))
    try:
        with _decompressed(archive, folder) as file, tarfile.open(fileobj=file, mode="r:") as tar:
            members = _members(tar, archive)
            tar.extractall(temporary, members, filter="data")
        unpacked = temporary / entry.code
        if not unpacked.is_dir():
            raise AssetError(f"{archive.name}: expected a folder {entry.code}, got {sorted(os.listdir(temporary))}.")
        mesh = _mesh_below(temporary, entry)
        if mesh is None:
            raise AssetError(f"{archive.name}: expected {entry.code}/google_16k/nontextured.stl in it, found no mesh.")
        _check(mesh, entry)
        if (folder / entry.code).exists():
            os.replace(folder / entry.code, temporary / "old")  # for an instant there is none
        os.replace(unpacked, folder / entry.code)
    except (AssetError, MissingDependencyError):
        raise
    except Exception as error:  # a damaged archive fails in many ways
        raise AssetError(
            f"{archive.name} cannot be unpacked ({type(error).__name__}: {error}). Run the command again."
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return folder / mesh.relative_to(temporary)


@contextlib.contextmanager
def _decompressed(archive: Path, folder: Path) -> Iterator[BinaryIO]:
    """Decompress the tar inside into a temporary file, so that its size is known before it is read."""
    with tempfile.TemporaryFile(dir=folder) as file:
        with gzip.open(archive) as compressed:
            while chunk := compressed.read(CHUNK):
                file.write(chunk)
                if file.tell() > MAX_UNPACKED:
                    raise AssetError(
                        f"{archive.name}: expected at most {MAX_UNPACKED >> 20} MB unpacked, got more. The archive is "
                        "not used; report it to where it came from."
                    )
        file.seek(0)
        yield file


def _members(tar: tarfile.TarFile, archive: Path) -> list[tarfile.TarInfo]:
    members: list[tarfile.TarInfo] = []
    for member in tar:
        parts = PurePosixPath(member.name).parts
        if ".." in parts or member.name.startswith("/") or not (member.isfile() or member.isdir()):
            raise AssetError(
                f"{archive.name} holds {member.name!r}, which would leave its folder or is no plain file. The "
                "archive is not used; report it to where it came from."
            )
        members.append(member)
        if len(members) > MAX_MEMBERS or sum(m.size for m in members) > MAX_UNPACKED:  # sparse files are small in it
            raise AssetError(
                f"{archive.name}: expected at most {MAX_MEMBERS} files of {MAX_UNPACKED >> 20} MB together, got more. "
                "The archive is not used; report it to where it came from."
            )
    return members


def _check(mesh: Path, entry: YcbObject) -> None:
    """Compare the size of a downloaded mesh with the table."""
    from difflcs_envs.trifinger.meshes import check_extent, load_mesh

    try:
        check_extent(load_mesh(mesh), entry.name, entry.size, mesh)
    except MeshError as error:
        raise AssetError(f"The download of {entry.name} is not used: {error}") from error


def _write_json(path: Path, content: dict[str, str]) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")
    os.replace(temporary, path)
