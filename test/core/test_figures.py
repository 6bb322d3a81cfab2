"""The figure of measured and predicted force: its content, and its file formats."""

from pathlib import Path

import numpy as np
from PIL import Image

from mr_damper_ros.api.comparison import Comparison, comparison_figure, save_figures
from mr_damper_ros.tools import identify, validate

BAG = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_0.5A"
SYNTHETIC = "re-synthesised from the published parameter sets; not the original recordings"
BEGINNINGS = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}


def comparison(name: str = "run", provenance: str = "", gap: float = 0.0) -> Comparison:
    time = np.arange(400) * 0.01
    time[200:] += gap
    velocity = np.cos(time)
    return Comparison(
        name=name,
        time=time,
        displacement=0.005 * np.sin(time),
        velocity=velocity,
        measured=1000.0 * velocity,
        predicted=900.0 * velocity,
        provenance=provenance,
    )


def test_the_title_tells_name_error_and_provenance() -> None:
    title = comparison_figure(comparison("/a/run", SYNTHETIC), "one set")._suptitle.get_text()
    assert title.splitlines()[0] == "run"
    assert "one set" in title
    assert "NRMSE 1" in title
    assert SYNTHETIC in title.replace("\n", " ")


def test_both_loops_force_residual_and_histogram_are_drawn() -> None:
    drawn = {axes.get_label(): axes for axes in comparison_figure(comparison()).axes}
    assert {"velocity", "displacement", "force", "residual", "histogram"} == set(drawn)
    for name in ("velocity", "displacement", "force"):
        assert [line.get_label() for line in drawn[name].lines] == ["measured", "predicted"]
    assert sum(bar.get_width() for bar in drawn["histogram"].patches) == 400


def test_runs_of_the_same_name_go_to_files_of_their_own(tmp_path: Path) -> None:
    runs = [comparison("a/run"), comparison("b/run.mcap"), comparison("../..")]
    written = save_figures(runs, tmp_path, ["png"])
    assert [path.name for path in written] == ["run.png", "run_2.png", "run_3.png"]
    assert all(path.parent == tmp_path and path.exists() for path in written)


def test_the_programs_draw_what_is_asked_for(tmp_path: Path) -> None:
    output = tmp_path / "set.yaml"
    drawing = ["--plot", str(tmp_path / "identify"), "--plot-format", *BEGINNINGS]
    arguments = [str(BAG), "--method", "least_squares", "--output", str(output)]
    assert identify.main([*arguments, *drawing]) == 0
    for ending, beginning in BEGINNINGS.items():
        assert (tmp_path / "identify" / f"{BAG.name}.{ending}").read_bytes().startswith(beginning)
    drawing = ["--plot", str(tmp_path / "validate"), "--plot-format", "svg"]
    assert validate.main([str(output), str(BAG), *drawing]) == 0
    assert (tmp_path / "validate" / f"{BAG.name}.svg").exists()


def test_the_heading_of_a_figure_is_the_title_of_its_file(tmp_path: Path) -> None:
    run = comparison(provenance=SYNTHETIC)
    (drawn,) = save_figures([run], tmp_path, ["png"], "one set")
    with Image.open(drawn) as image:
        assert image.info["Title"] == comparison_figure(run, "one set")._suptitle.get_text()
