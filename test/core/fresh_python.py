"""Output of commands and of a fresh Python process."""

import subprocess
import sys
from typing import Any


def said(*command: Any, **options: Any) -> str:
    """Output of a command that must succeed; ``options`` as those of subprocess.run."""
    entries: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 120, **options}
    done = subprocess.run([str(word) for word in command], check=False, **entries)
    assert done.returncode == 0, done.stderr
    return str(done.stdout)


def alone(code: str) -> str:
    """Output of a fresh Python process that has the paths of this one, but has imported nothing."""
    return said(sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}\n{code}")
