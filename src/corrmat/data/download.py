"""Download and unpack a data set from servers that may stall, truncate or disappear."""

import hashlib
import json
import logging
import shutil
import stat
import urllib.error
import urllib.request
import zipfile
from collections.abc import Sequence
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from typing import IO

from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from corrmat.errors import CorrmatError
from corrmat.files import replace_text

log = logging.getLogger(__name__)
TIMEOUT = 30.0  # seconds without a byte
TRIES = 3  # of each mirror; each continues where the last one stopped
_CHUNK = 2**18


def fetch(
    mirrors: Sequence[str], path: Path, sha256: str | None = None, timeout: float = TIMEOUT
) -> None:
    """Download a file, continuing an earlier partial download.

    Certificates are always checked. Without a digest the first download is trusted: its digest is
    printed and kept beside the file, and later downloads must match it.

    Args:
        mirrors: addresses of the same file, tried in turn.
        path: of the file; it appears complete and checked, or not at all.
        sha256: its digest, if available.
        timeout: seconds without a byte after which a server is given up.

    Raises:
        CorrmatError: no mirror has the file; the message says what each answered.
    """
    trusted = path.with_name(path.name + ".sha256")
    if sha256 is None and trusted.is_file():
        sha256 = trusted.read_text().split()[0]
    path.parent.mkdir(parents=True, exist_ok=True)
    failures = []
    for mirror in mirrors:
        for _ in range(TRIES):
            try:
                _continue_download(mirror, path, timeout)
                digest = _digest(_partial(path))
                if sha256 not in (None, digest):
                    _drop(path)
                    raise CorrmatError(f"its SHA-256 is {digest}, not {sha256}")
                _partial(path).replace(path)
                _drop(path)
                if sha256 is None:
                    log.info("%s: SHA-256 %s, trusted from now on", path.name, digest)
                    replace_text(trusted, f"{digest}  {path.name}\n")
                return
            except urllib.error.HTTPError as error:
                failures.append(f"{mirror}: HTTP {error.code} {error.reason}")
                if error.code != 416:
                    break
                _drop(path)  # nothing is left to send: the partial download is of another file
            except CorrmatError as error:
                failures.append(f"{mirror}: {error}")
                break
            except (OSError, HTTPException, ValueError) as error:
                failures.append(f"{mirror}: {error or type(error).__name__}")
    raise CorrmatError(f"cannot fetch {path.name}: " + "; ".join(dict.fromkeys(failures)))


def unzip(archive: Path, folder: Path, name: str) -> None:
    """Unpack folder `name` of an archive into `folder`, completely or not at all.

    Raises:
        CorrmatError: it is not a complete zip, lacks that folder, or a member is a link or has a
            path that leads out of it.
    """
    staging = folder / f".{name}.partial"
    shutil.rmtree(staging, ignore_errors=True)
    try:
        with zipfile.ZipFile(archive) as file:
            for member in file.infolist():
                target = (staging / member.filename).resolve()
                if not target.is_relative_to(staging.resolve()):
                    raise CorrmatError(f"{archive}: {member.filename!r} leads out of the folder")
                if stat.S_ISLNK(member.external_attr >> 16):
                    raise CorrmatError(f"{archive}: {member.filename!r} is a link")
            damaged = file.testzip()
            if damaged:
                raise CorrmatError(f"{archive}: {damaged} is damaged; {_advice(archive)}")
            file.extractall(staging)
        if not (staging / name).is_dir():
            raise CorrmatError(f"{archive} does not hold the folder {name}")
        (staging / name).replace(folder / name)
    except (CorrmatError, OSError):
        raise
    except Exception as error:  # damaged or encrypted archives raise errors of every type
        raise CorrmatError(f"{archive} is no whole zip file; {_advice(archive)}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _advice(archive: Path) -> str:
    return f"delete it and {archive.name}.sha256, and fetch it again"


def _continue_download(mirror: str, path: Path, timeout: float) -> None:
    """Append to the partial download of this mirror's file until it is complete.

    Raises:
        OSError: the server stops or stalls; the partial download is kept for the next try.
    """
    partial, about = _partial(path), _about(path)
    state = json.loads(about.read_text()) if about.is_file() else {}
    if state.get("mirror") != mirror:  # never continue one server's file with another's
        _drop(path)
        state = {"mirror": mirror}
    done = partial.stat().st_size if partial.is_file() else 0
    request = urllib.request.Request(mirror)
    if done and state.get("tag"):
        request.add_header("Range", f"bytes={done}-")
        request.add_header("If-Range", state["tag"])
    with urllib.request.urlopen(request, timeout=timeout) as answer:
        if answer.status != 206:
            done = 0
        length = answer.headers.get("Content-Length")
        total = None if length is None else done + int(length)
        tag = answer.headers.get("ETag") or answer.headers.get("Last-Modified")
        replace_text(about, json.dumps(state | {"tag": tag}))
        with partial.open("ab" if done else "wb") as file:
            _copy(answer, file, done, total, path.name)
        size = partial.stat().st_size
    if total is not None and size != total:
        raise OSError(f"cut short after {size} of {total} bytes")


def _copy(answer: HTTPResponse, file: IO[bytes], done: int, total: int | None, name: str) -> None:
    """Copy an answer to a file with a progress bar."""
    columns = BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn()
    with Progress(name, *columns, transient=True) as progress:
        task = progress.add_task(name, total=total, completed=done)
        while chunk := answer.read1(_CHUNK):
            file.write(chunk)
            progress.advance(task, len(chunk))


def _partial(path: Path) -> Path:
    return path.with_name(path.name + ".partial")


def _about(path: Path) -> Path:
    return path.with_name(path.name + ".partial.json")


def _drop(path: Path) -> None:
    _partial(path).unlink(missing_ok=True)
    _about(path).unlink(missing_ok=True)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
