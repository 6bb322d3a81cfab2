"""Build of the package mr_damper_ros: called by colcon, and by pip and build for a wheel."""

import importlib.util
import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

NAME = "mr_damper_ros"
ROOT = Path(__file__).resolve().parent  # colcon runs a link to this file
NODES = (
    *("bridge", "campaign", "controller", "identifier", "live", "model", "replay", "supply"),
    "suspension",
)

BY_COLCON = bool({"develop", "install"} & set(sys.argv))
"""Whether colcon calls this file, not pip or build for a wheel.

colcon installs programs where `ros2 run` looks (setup.cfg), so that the nodes can have short names.
pip installs programs on the PATH, where names like `live`, `model` and `replay` have no place.
"""


class BuildPy(build_py):
    """Modules and the message definitions of a bag, so that writing bags needs no workspace."""

    def run(self) -> None:
        """Copy the files; called by setuptools."""
        super().run()
        if not self.editable_mode:
            folder = Path(self.build_lib, NAME, "io", "msg")
            folder.mkdir(parents=True, exist_ok=True)
            for message in ("MtsSamples", "SupplyCurrent"):
                self.copy_file(str(ROOT / "msg_defs" / "msg" / f"{message}.msg"), str(folder))


def data_files(*patterns: str) -> list[tuple[str, list[str]]]:
    """Return the matching files by the folder under ``share`` into which they are installed."""
    folders: dict[str, list[str]] = {}
    for pattern in patterns:
        for path in sorted(Path().glob(pattern)):
            if path.is_file():
                folders.setdefault(f"share/{NAME}/{path.parent}", []).append(str(path))
    return list(folders.items())


package = ElementTree.parse(ROOT / "package.xml").getroot()
maintainer = package.find("maintainer")
assert maintainer is not None

if BY_COLCON and not importlib.util.find_spec("mr_damper_msgs"):
    print(
        "The package mr_damper_msgs is not built, and no node starts without it: link its folder "
        "beside this package (ln -s mr_damper_ros/msg_defs src/mr_damper_msgs) and build again.",
        file=sys.stderr,
    )

setup(
    name=NAME,
    version=package.findtext("version"),
    description="Identifies a magnetorheological damper while it runs, and predicts its force",
    long_description=(ROOT / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    maintainer=maintainer.text,
    maintainer_email=maintainer.get("email"),
    url=package.findtext("url[@type='website']"),
    project_urls={
        "Source": package.findtext("url[@type='repository']"),
        "Issues": package.findtext("url[@type='bugtracker']"),
    },
    license=package.findtext("license"),
    keywords=["magnetorheological damper", "system identification", "ROS 2"],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in range(10, 14)),
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={
        NAME: ["py.typed"],
        f"{NAME}.models": ["*.csv"],
        f"{NAME}.control.export": ["*.in"],
        f"{NAME}.live": ["page/*", "page/vendor/*/*"],
        f"{NAME}.report": ["*.css", "*.mplstyle"],
        f"{NAME}.rig.supplies": ["profiles/*.yaml"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *data_files("config/**/*", "launch/**/*.py", "bags/**/*"),
    ],
    python_requires=">=3.10",
    install_requires=[
        "matplotlib>=3.6",
        "mcap>=1.2.2",
        "numpy>=1.26",
        "PyYAML>=6.0",
        "rosbags>=0.11.9",
        "scipy>=1.11",
    ],
    extras_require={
        "test": ["pytest"],
        "fast": ["numba==0.68.1"],
        "live": ["aiohttp>=3.9"],
        "files": ["openpyxl==3.1.5", "npTDMS==1.13.0"],
        "mf4": ["asammdf==8.8.28"],
        "serial": ["pyserial==3.5"],
        "daq": ["nidaqmx==1.7.0", "labjack-ljm==1.23.0", "uldaq==1.2.3"],
        "visa": ["PyVISA==1.16.2", "PyVISA-py==0.8.1"],
    },
    zip_safe=False,
    cmdclass={"build_py": BuildPy},
    entry_points={
        "console_scripts": [
            f"mr-damper = {NAME}.__main__:main",
            *(f"{node} = {NAME}.entry_points:{node}" for node in NODES if BY_COLCON),
        ],
    },
)
