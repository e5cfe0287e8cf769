"""The commit of the code, for the records that it writes."""

import subprocess
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent


def commit() -> str | None:
    """Return the commit of the code, with "+" if files have changed; None outside a checkout.

    Ask before long work starts: by its end, the files may be another commit's.
    """
    try:
        changed = git(PACKAGE, "status", "--porcelain", "--", ".", "../../configs")
        head = git(PACKAGE, "rev-parse", "--short=12", "HEAD")
        # git may track a folder that this package is only installed into.
        tracked = git(PACKAGE, "ls-files", "--error-unmatch", "__init__.py")
    except OSError:
        return None
    if head.returncode or changed.returncode or tracked.returncode:
        return None
    return head.stdout.strip() + ("+" if changed.stdout.strip() else "")


def git(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run git in a folder.

    Raises:
        OSError: git is not installed.
    """
    return subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True)
