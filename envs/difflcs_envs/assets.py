"""The YCB meshes on this machine: find them, or download them from the YCB site with `pooch`.

The archives are kept whole: their SHA-256 is recorded at the first download and every later download must match it.
A new archive and its mesh are checked in a hidden folder, and renamed from there. One process at a time works in a
folder; the others wait.
"""

import json
import os
import shutil
import tarfile
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from difflcs_envs.errors import AssetError, MeshError, MissingDependencyError, extra
from difflcs_envs.locks import one_at_a_time
from difflcs_envs.ycb import YCB, YcbObject

YCB_URL = "https://ycb-benchmarks.s3.amazonaws.com/data/google/{code}_google_16k.tgz"
YCB_DIR_VARIABLE = "DIFFLCS_YCB_DIR"
TIMEOUT = 30.0  # [s] without a byte
ATTEMPTS = 3
MAX_UNPACKED = 1 << 29  # [byte]; the largest of these objects has 1 << 27
WORK = ".download-"  # prefix of the hidden folders

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
        waiting = f"another process downloads into {folder}: waiting for it"
        with one_at_a_time(folder / ".lock", lambda: report(waiting)):
            for leftover in folder.glob(f"{WORK}*"):  # of a process that was killed: the folder is ours
                shutil.rmtree(leftover, ignore_errors=True)
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


def _download_object(entry: YcbObject, folder: Path, address: str, report: Callable[[str], object]) -> Path:
    with extra():
        import pooch
    archive, known = folder / f"{entry.code}_google_16k.tgz", _known_hashes(folder)
    with tempfile.TemporaryDirectory(dir=folder, prefix=WORK) as temporary:
        work, source, wanted = Path(temporary), archive, known.get(archive.name)
        if not archive.exists() or wanted not in (None, pooch.file_hash(archive)):
            source = _fetch(address, work / archive.name, wanted)
        known[archive.name] = digest = pooch.file_hash(source)
        mesh = _unpack(source, work, entry)
        os.replace(source, archive)
        if (folder / entry.code).exists():
            os.replace(folder / entry.code, work / "old")  # for an instant there is none
        os.replace(work / entry.code, folder / entry.code)
        (work / "sha256.json").write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")
        os.replace(work / "sha256.json", folder / "sha256.json")
    report(f"{entry.name}: {folder / mesh} (sha256 {digest[:12]}...)")
    return folder / mesh


def _fetch(address: str, path: Path, wanted: str | None) -> Path:
    """Download a file, whose SHA-256 must be as `wanted`."""
    import pooch
    from requests import RequestException

    pooch.get_logger().setLevel("WARNING")
    downloader: Any = pooch.HTTPDownloader(timeout=TIMEOUT)  # its type does not fit that of `fetch`
    hashes, urls = {path.name: wanted}, {path.name: address}
    site = pooch.create(path.parent, "", registry=hashes, urls=urls, retry_if_failed=ATTEMPTS - 1)
    try:
        return Path(site.fetch(path.name, downloader=downloader))
    except (OSError, ValueError, LookupError) as error:
        if isinstance(error, OSError) and not isinstance(error, RequestException):
            raise  # of the folder
        raise AssetError(
            f"{address} could not be downloaded: {error}. Check the network and the address and run the command again; "
            f"with meshes from elsewhere let {YCB_DIR_VARIABLE} name their folder. If the hash is another one and you "
            f"trust the new file, remove {path.name} from sha256.json."
        ) from error


def _known_hashes(folder: Path) -> dict[str, str]:
    path = folder / "sha256.json"
    try:
        known = json.loads(path.read_bytes())
        if not isinstance(known, dict) or not all(isinstance(value, str) for value in known.values()):
            raise ValueError("something else")
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise AssetError(f"{path}: expected recorded checksums, cannot read them ({error}). Delete it.") from error
    return known


def _unpack(archive: Path, folder: Path, entry: YcbObject) -> Path:
    """Unpack into a folder, check the mesh, and return its path in there."""
    from difflcs_envs.trifinger.meshes import check_extent, load_mesh

    try:
        with tarfile.open(archive, "r:gz") as tar:
            if sum(member.size for member in tar) > MAX_UNPACKED:
                raise ValueError(f"expected at most {MAX_UNPACKED >> 20} MB unpacked, got more")
            tar.extractall(folder, filter="data")
        mesh = _mesh_below(folder, entry)
        if mesh is None or not (folder / entry.code).is_dir():
            raise ValueError(f"expected {entry.code}/google_16k/nontextured.stl in it, found no such mesh")
        check_extent(load_mesh(mesh), entry.name, entry.size, mesh)
    except MissingDependencyError:
        raise
    except Exception as error:  # a damaged archive fails in many ways
        raise AssetError(
            f"{archive.name} is not used ({type(error).__name__}: {error}). Run the command again; if that does not "
            f"help, report it to where it came from."
        ) from error
    return mesh.relative_to(folder)
