import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from vg2gt.cli.data import write_views
from vg2gt.data import DataError, SceneSource, SyntheticScenes
from vg2gt.data.views import SceneSample
from vg2gt.data.views.drawn import ViewSelection, index_path, make_index, read_index


def listed(frames: Sequence[int], held_out: Sequence[int] = ()) -> SceneSource:
    """Scenes that are nothing but lists of frames."""
    source = SyntheticScenes(1)
    source.frames, source.held_out = lambda scene: frames, lambda scene: held_out
    return source


@pytest.mark.parametrize("count", [1, 8])
def test_a_window_grows_until_it_holds_a_held_out_frame(count: int) -> None:
    source = listed(range(200), held_out=range(0, 200, 8))
    for scene in map(str, range(40)):
        views = ViewSelection(spread=2.0).draw(source, scene, count)
        assert views.target
        assert all(frame % 8 == 0 for frame in views.target)
        assert all(frame % 8 for frame in views.context)
        assert max(views.context + views.target) - min(views.context + views.target) <= max(8, 2 * count)
        assert not ViewSelection(targets=0).draw(source, scene, count).target
    elsewhere = listed(range(20), held_out=[77])  # a held-out frame that the scene lacks
    assert len(ViewSelection().draw(elsewhere, "a", 3).context) == 3


@pytest.mark.parametrize(("context", "target"), [([3, 9], [3]), ([3, 9, 12], [4])])
def test_an_index_that_mixes_input_and_target_or_miscounts_is_refused(tmp_path: Path, context, target) -> None:
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"scenes": {"a": {"2": {"context": context, "target": target}}}}))
    with pytest.raises(DataError, match="views of scene a must be 2 distinct input views and distinct held-out"):
        ViewSelection(index=str(path)).choose(listed(range(40)), ["a"], 2)


def test_an_index_overrides_the_draw_and_gaps_are_drawn_with_a_warning(tmp_path: Path, caplog) -> None:
    path = tmp_path / "mine.json"
    entry = {"context": [7, 5], "target": [6]}
    path.write_text(json.dumps({"scenes": {"a": {"2": entry}}}))
    selection = ViewSelection(index=str(path))
    source = listed(range(40))
    first, second = selection.choose(source, ["a", "b"], 2)
    assert (first, second) == (SceneSample("a", (7, 5), (6,)), selection.draw(source, "b", 2))
    assert "mine.json has no entry with 2 views for 1 of 2 scenes (first: b)" in caplog.text


def test_wrong_indices_and_too_few_frames_are_named(tmp_path: Path) -> None:
    source = listed(range(10))
    with pytest.raises(FileNotFoundError, match=r"available: .*synthetic"):
        read_index("nowhere")
    (tmp_path / "bad.json").write_text('{"scenes": {"a": {"2": [1, 2]}}}')
    with pytest.raises(ValueError, match="not an index"):
        read_index(str(tmp_path / "bad.json"))
    (tmp_path / "other.json").write_text('{"scenes": {"a": {"1": {"context": [77], "target": []}}}}')
    with pytest.raises(DataError, match=r"frames \[77\] of scene a"):
        ViewSelection(index=str(tmp_path / "other.json")).choose(source, ["a"], 1)
    with pytest.raises(DataError, match=r"scene a has 10 frames .* views=11"):
        ViewSelection().draw(source, "a", 11)
    with pytest.raises(ValueError, match=r"spread=0\.5"):
        ViewSelection(spread=0.5)


def test_the_command_writes_what_is_committed(tmp_path: Path) -> None:
    path = write_views(str(tmp_path / "again.json"), ["evaluation=synthetic"])
    assert path.read_text() == index_path("synthetic").read_text()
    assert set(read_index("synthetic")["room-1000000"]) == {"3", "10", "20"}


def test_dtus_index_is_what_its_49_frames_give_but_for_the_three_fixed_views() -> None:
    stored = read_index("dtu")
    assert len(stored) == 15
    drawn = make_index(ViewSelection(), listed(range(49)), list(stored), [10, 20])["scenes"]
    assert drawn == {scene: {count: views[count] for count in ("10", "20")} for scene, views in stored.items()}
    assert all(views["3"]["context"] == [23, 24, 33] for views in stored.values())
