"""What commands say, and what a fresh Python prints."""

from __future__ import annotations

import subprocess
import sys
from typing import Any


def said(*command: Any, **options: Any) -> str:
    """What a command prints, which must end well; ``options`` as those of subprocess.run."""
    entries: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 120, **options}
    done = subprocess.run([str(word) for word in command], check=False, **entries)
    assert done.returncode == 0, done.stderr
    return str(done.stdout)


def alone(code: str) -> str:
    """What a fresh Python prints that knows the paths of this one, but has loaded nothing."""
    return said(sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}\n{code}")
