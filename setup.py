"""Build of the package mr_damper_ros, called by colcon."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "mr_damper_ros"
NODES = ("bridge", "identifier", "model", "replay")
TOOLS = ("identify", "import_record", "reproduce", "thesis_bags", "validate")


def data_files(*patterns: str) -> list[tuple[str, list[str]]]:
    """Return the files that match, each with the folder under ``share`` it is installed to."""
    folders: dict[str, list[str]] = {}
    for pattern in patterns:
        for path in sorted(Path().glob(pattern)):
            if path.is_file():
                folders.setdefault(f"share/{NAME}/{path.parent}", []).append(str(path))
    return list(folders.items())


setup(
    name=NAME,
    version="0.1.0",
    description="Identifies a magnetorheological damper while it runs, and predicts its force",
    maintainer="mr_damper_ros maintainers",
    maintainer_email="maintainers@example.com",
    license="Apache-2.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed"], f"{NAME}.thesis": ["*.csv"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *data_files("config/**/*.yaml", "config/**/*.xml", "launch/**/*.py", "bags/**/*"),
    ],
    python_requires=">=3.10",
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    entry_points={
        "console_scripts": [f"{name} = {NAME}.entry_points:{name}" for name in NODES]
        + [f"{name} = {NAME}.tools.{name}:main" for name in TOOLS]
        + [f"demo = {NAME}.nodes.demo:main"],
    },
)
