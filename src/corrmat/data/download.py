"""Fetching and unpacking a data set from servers that may lie, stall or vanish."""

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
TRIES = 3  # of each mirror, each going on where the last one stopped
_CHUNK = 2**18


def fetch(
    mirrors: Sequence[str], path: Path, sha256: str | None = None, timeout: float = TIMEOUT
) -> None:
    """Download a file, going on from what an earlier try left behind.

    Certificates are always checked. Without a known digest the first download is trusted: its
    digest is printed and kept beside the file, and later downloads must have it.

    Args:
        mirrors: addresses of the same file, tried in turn.
        path: where it goes; it is there whole and checked, or not at all.
        sha256: its digest, if one is known.
        timeout: seconds without a byte before a server is given up.

    Raises:
        CorrmatError: no mirror gave the file; the message says what each did.
    """
    trusted = path.with_name(path.name + ".sha256")
    if sha256 is None and trusted.is_file():
        sha256 = trusted.read_text().split()[0]
    path.parent.mkdir(parents=True, exist_ok=True)
    failures = []
    for mirror in mirrors:
        for _ in range(TRIES):
            try:
                _go_on(mirror, path, timeout)
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
                _drop(path)  # nothing is left to send: what is here is not its file
            except CorrmatError as error:
                failures.append(f"{mirror}: {error}")
                break
            except (OSError, HTTPException, ValueError) as error:
                failures.append(f"{mirror}: {error or type(error).__name__}")
    raise CorrmatError(f"cannot fetch {path.name}: " + "; ".join(dict.fromkeys(failures)))


def unzip(archive: Path, folder: Path, name: str) -> None:
    """Unpack folder `name` of an archive into `folder`, all of it or nothing.

    Raises:
        CorrmatError: it is no whole zip, does not hold that folder, or a member's path leads out
            of it or is a link.
    """
    aside = folder / f".{name}.partial"
    shutil.rmtree(aside, ignore_errors=True)
    try:
        with zipfile.ZipFile(archive) as file:
            for member in file.infolist():
                target = (aside / member.filename).resolve()
                if not target.is_relative_to(aside.resolve()):
                    raise CorrmatError(f"{archive}: {member.filename!r} leads out of the folder")
                if stat.S_ISLNK(member.external_attr >> 16):
                    raise CorrmatError(f"{archive}: {member.filename!r} is a link")
            damaged = file.testzip()
            if damaged:
                raise CorrmatError(f"{archive}: {damaged} is damaged; {_again(archive)}")
            file.extractall(aside)
        if not (aside / name).is_dir():
            raise CorrmatError(f"{archive} does not hold the folder {name}")
        (aside / name).replace(folder / name)
    except (CorrmatError, OSError):
        raise
    # Damaged, encrypted or oddly packed archives fail in the words of as many libraries.
    except Exception as error:
        raise CorrmatError(f"{archive} is no whole zip file; {_again(archive)}") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _again(archive: Path) -> str:
    return f"delete it and {archive.name}.sha256, and fetch it again"


def _go_on(mirror: str, path: Path, timeout: float) -> None:
    """Append to what is there of this mirror's file until it is whole.

    Raises:
        OSError: the server stops or stalls; what came is kept for the next try.
    """
    partial, about = _partial(path), _about(path)
    known = json.loads(about.read_text()) if about.is_file() else {}
    if known.get("mirror") != mirror:  # never mend one server's file with another's
        _drop(path)
        known = {"mirror": mirror}
    done = partial.stat().st_size if partial.is_file() else 0
    request = urllib.request.Request(mirror)
    if done and known.get("tag"):
        request.add_header("Range", f"bytes={done}-")
        request.add_header("If-Range", known["tag"])
    with urllib.request.urlopen(request, timeout=timeout) as answer:
        if answer.status != 206:
            done = 0
        length = answer.headers.get("Content-Length")
        total = None if length is None else done + int(length)
        tag = answer.headers.get("ETag") or answer.headers.get("Last-Modified")
        replace_text(about, json.dumps(known | {"tag": tag}))
        with partial.open("ab" if done else "wb") as file:
            _copy(answer, file, done, total, path.name)
        size = partial.stat().st_size
    if total is not None and size != total:
        raise OSError(f"cut short after {size} of {total} bytes")


def _copy(answer: HTTPResponse, file, done: int, total: int | None, name: str) -> None:  # noqa: ANN001
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
