"""Every rule removes exactly what it is meant for, says why, and nothing is lost on the way."""

import gzip
import json
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner

from datagen.cli.main import main
from datagen.config import load_config
from datagen.input_error import InputError
from datagen.jobs.select_motions import Selection, select_motions
from datagen.plan.plan import SELECTION_FILE
from datagen.plan.selection_rules import Rule, removed_by_rule
from shards.settings import SettingsError
from tests.datagen.grasps.recorded.graspxl_sample import SAMPLE, needs_sample
from tests.datagen.grasps.recorded.official_files import still_arrays, write_sequence
from tests.datagen.licensed_config import IDS, ROOT, write_config, write_inputs

BREAD, ROCK, LANTERN = IDS


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder


@pytest.fixture
def own_inputs(inputs, tmp_path) -> Path:
    """A copy that a test may spoil."""
    shutil.copytree(inputs, tmp_path / "inputs")
    return tmp_path / "inputs"


def selected(folder: Path, change=None, **options) -> Selection:
    return select_motions(load_config(write_config(folder, change)), folder / "out", **options)


def rules(selection: Selection) -> dict[str, int]:
    return dict(Counter(decision.rule for decision in selection.decisions))


def annotate(folder: Path, uid: str, **values: object) -> None:
    for path in (folder / "store" / "metadata").iterdir():
        records = json.loads(gzip.decompress(path.read_bytes()))
        if uid in records:
            records[uid] |= values
            path.write_bytes(gzip.compress(json.dumps(records).encode()))


def test_everything_sound_is_kept_with_its_metrics(own_inputs):
    selection = selected(own_inputs)
    assert len(selection.kept) == len(selection.decisions) == 6
    for decision in selection.decisions:
        assert (decision.rule, decision.reason) == ("", "")
        assert decision.texture_resolution_px > 0
        assert decision.rise_m == pytest.approx(0.2, abs=1e-6)
        assert decision.travel_m == pytest.approx(0.2, abs=1e-4)


@pytest.mark.parametrize(
    ("change", "rule", "uid", "reason"),
    [
        (lambda c: c["objects"].update(exclude=[f"objaverse/{ROCK}@large"]), Rule.EXCLUDED, ROCK, "objects.exclude"),
        (
            lambda c: c["selection"].update(licence_allow=["by", "by-nc"]),
            Rule.LICENCE,
            ROCK,
            "CC0-1.0; allowed: CC-BY-4.0, CC-BY-NC-4.0",
        ),
        (lambda c: c["selection"]["texture"].update(min_resolution_px=10_000), Rule.TEXTURE, None, "10000 wanted"),
        (lambda c: c["selection"]["texture"].update(min_color_detail=0.99), Rule.TEXTURE, None, "0.99 wanted"),
        (lambda c: c["selection"]["movement"].update(min_rise_m=0.3), Rule.MOVEMENT, None, "rises 0.200 m, 0.3 wanted"),
        (lambda c: c["selection"]["movement"].update(min_travel_m=0.4), Rule.MOVEMENT, None, "0.4 wanted"),
        (lambda c: c["selection"]["movement"].update(min_rotation_rad=0.5), Rule.MOVEMENT, None, "turns 0.000 rad"),
    ],
)  # fmt: skip
def test_a_threshold_removes_with_metrics(own_inputs, change, rule, uid, reason):
    selection = selected(own_inputs, change)
    removed = [d for d in selection.decisions if not d.kept]
    assert {d.rule for d in removed} == {rule.value}
    expected = {f"objaverse/{name}@large" for name in ([uid] if uid else IDS)}
    assert {d.object_uid for d in removed} == expected
    assert len(removed) == 2 * len(expected)
    assert all(reason in d.reason for d in removed)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"animationCount": 2}, "2 animations"),
        ({"isAgeRestricted": True}, "age restricted"),
        ({"faceCount": 5_000_000}, "5000000 faces"),
        ({"archives": {"glb": {"textureCount": 0}}}, "0 textures, at least 1 wanted"),
    ],
)
def test_annotations_remove_before_a_mesh_is_read(own_inputs, values, reason):
    annotate(own_inputs, BREAD, **values)
    selection = selected(own_inputs)
    removed = [d for d in selection.decisions if not d.kept]
    assert [(d.rule, d.object_uid) for d in removed] == [
        (Rule.ANNOTATION.value, f"objaverse/{BREAD}@large")
    ] * 2
    assert all(reason in d.reason and np.isnan(d.texture_resolution_px) for d in removed)


@pytest.mark.parametrize(
    ("line", "n_removed"),
    [
        (BREAD, 2),
        (BREAD.upper(), 2),
        (f"https://sketchfab.com/3d-models/a-loaf-of-bread-{BREAD}", 2),
        (f"objaverse/{BREAD}", 2),
        (f"objaverse/{BREAD}@large", 2),
        (f"objaverse/{BREAD}@large-mirrored", 2),  # as a shard names the mirror image
        (f"mano_dataset_1/large/{BREAD}/mano_2", 1),
    ],
)
def test_the_takedown_list_names_objects_sizes_or_single_motions(own_inputs, line, n_removed):
    (own_inputs / "takedown.txt").write_text(f"# asked by the author\n\n{line}  # 2026-11-22\n")
    selection = selected(own_inputs, lambda c: c["selection"].update(takedown="takedown.txt"))
    assert rules(selection).get(Rule.TAKEDOWN.value, 0) == n_removed
    assert selection.unmatched == ()


def test_takedown_entries_that_name_nothing_are_told(own_inputs):
    (own_inputs / "takedown.txt").write_text(f"objaverse/{BREAD}@small\nstarter/mlik\n")
    selection = selected(own_inputs, lambda c: c["selection"].update(takedown="takedown.txt"))
    assert selection.unmatched == (f"objaverse/{BREAD}@small", "starter/mlik")
    assert len(selection.kept) == 6


def test_an_exclusion_that_names_nothing_is_an_error_with_a_suggestion(own_inputs):
    wrong = f"objaverse/{BREAD}@larg"
    with pytest.raises(InputError, match=rf"names {wrong}.*Did you mean 'objaverse/{BREAD}@large'"):
        selected(own_inputs, lambda c: c["objects"].update(exclude=[wrong]))
    whole = selected(own_inputs, lambda c: c["objects"].update(exclude=[f"objaverse/{BREAD}"]))
    assert rules(whole)[Rule.EXCLUDED.value] == 2


def test_the_licence_of_the_motions_must_be_allowed_too(own_inputs):
    selection = selected(own_inputs, lambda c: c["selection"].update(licence_allow=["cc0", "by"]))
    assert rules(selection) == {Rule.LICENCE.value: 6}
    assert all("of the recorded motion: CC-BY-NC-4.0" in d.reason for d in selection.decisions)


def test_another_licence_in_the_metadata_is_noticed(own_inputs):
    assert len(selected(own_inputs).kept) == 6
    annotate(own_inputs, BREAD, license="by-nc-nd")
    assert rules(selected(own_inputs)) == {"": 4, Rule.LICENCE.value: 2}


def test_a_bare_mesh_keeps_the_licence_of_the_model_it_derives_from(own_inputs):
    annotate(own_inputs, BREAD, license="by-nc-nd")
    selection = selected(own_inputs, lambda c: c["objects"].update(textures="none"))
    removed = [d for d in selection.decisions if not d.kept]
    assert {d.object_uid for d in removed} == {f"objaverse/{BREAD}@large"}
    assert all("CC-BY-NC-4.0 AND CC-BY-NC-ND-4.0" in d.reason for d in removed)
    assert {d.appearance for d in selection.kept} == {"generated"}


def test_places_of_files_do_not_change_the_decision(own_inputs):
    selected(own_inputs)
    looked: list[int] = []
    selected(
        own_inputs,
        lambda c: c["objects"].update(cache_dir=str(own_inputs / "elsewhere")),
        report=lambda done, total: looked.append(done),
    )
    assert not looked


def test_the_selection_of_a_plan_is_not_overwritten(own_inputs):
    config = write_config(own_inputs)
    arguments = ["--config", str(config), "--out", str(own_inputs / "out")]
    assert CliRunner().invoke(main, ["plan", *arguments]).exit_code == 0
    before = (own_inputs / "out" / SELECTION_FILE).read_bytes()
    result = CliRunner().invoke(main, ["select", *arguments, "--license-allow", "by,by-nc"])
    assert result.exit_code == 2
    assert "belongs to the plan beside it" in result.output
    assert (own_inputs / "out" / SELECTION_FILE).read_bytes() == before


def test_plans_made_at_the_same_time_are_one_plan(own_inputs):
    """As a job array does that starts on an empty folder."""
    config, out = write_config(own_inputs), own_inputs / "out"
    command = [sys.executable, "-m", "datagen", "plan", "--config", str(config), "--out", str(out)]
    runs = [subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    errors = [run.communicate()[1] for run in runs]
    assert [run.returncode for run in runs] == [0, 0, 0], errors
    assert len(pq.read_table(out / SELECTION_FILE)) == 6


def test_a_longer_takedown_list_takes_effect_at_once(own_inputs):
    def with_list(config):
        config["selection"]["takedown"] = "takedown.txt"

    (own_inputs / "takedown.txt").write_text("")
    assert len(selected(own_inputs, with_list).kept) == 6
    (own_inputs / "takedown.txt").write_text(BREAD)
    assert len(selected(own_inputs, with_list).kept) == 4


def test_a_missing_takedown_list_is_an_error_not_an_empty_list(own_inputs):
    with pytest.raises(InputError, match=r"none\.txt: cannot be read"):
        selected(own_inputs, lambda c: c["selection"].update(takedown="none.txt"))


def test_what_cannot_be_read_is_counted_with_the_reader_s_reason(own_inputs):
    next((own_inputs / "store").glob(f"glbs/*/{ROCK}.glb")).write_bytes(b"not a model")
    still = still_arrays(LANTERN)
    del still["right_hand"]["pose"]
    write_sequence(own_inputs / "graspxl", "mano_dataset_1", "large", LANTERN, 1, still)
    selection = selected(own_inputs)
    assert rules(selection) == {"": 3, Rule.UNUSABLE.value: 2, Rule.SEQUENCE.value: 1}
    counts = removed_by_rule(selection.decisions)
    assert counts[Rule.UNUSABLE] == (2, 1)
    assert counts[Rule.SEQUENCE] == (1, 1)
    assert sum(motions for motions, _ in counts.values()) == len(selection.decisions) - len(selection.kept)
    reasons = {d.rule: d.reason for d in selection.decisions}
    assert f"{ROCK}.glb" in reasons[Rule.UNUSABLE.value]
    assert "lacks right_hand.pose" in reasons[Rule.SEQUENCE.value]


def test_a_sequence_without_its_object_is_removed_not_overlooked(own_inputs):
    shutil.rmtree(own_inputs / "graspxl" / "object_dataset" / "large" / ROCK)
    assert rules(selected(own_inputs)) == {"": 4, Rule.UNUSABLE.value: 2}


def test_the_file_holds_every_decision_and_is_used_again(own_inputs):
    selection = selected(own_inputs, lambda c: c["selection"].update(licence_allow=["by", "by-nc"]))
    path = own_inputs / "out" / SELECTION_FILE
    rows = pq.read_table(path).to_pylist()
    assert [row["reason"] for row in rows] == [d.reason for d in selection.decisions]
    before = path.stat().st_mtime_ns
    looked: list[int] = []
    again = selected(
        own_inputs,
        lambda c: c["selection"].update(licence_allow=["by", "by-nc"]),
        report=lambda done, total: looked.append(done),
    )
    np.testing.assert_equal([vars(d) for d in again.decisions], [vars(d) for d in selection.decisions])
    assert not looked
    assert path.stat().st_mtime_ns == before


def test_a_stopped_run_goes_on_where_it_was_and_ends_the_same(own_inputs):
    class StopError(Exception):
        pass

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise StopError

    with pytest.raises(StopError):
        selected(own_inputs, report=stop)
    partial = own_inputs / "out" / "selection.partial.jsonl"
    with partial.open("a") as file:
        file.write('{"uid": "cut in the mid')  # killed while writing
    looked: list[tuple[int, int]] = []
    resumed = selected(own_inputs, report=lambda done, total: looked.append((done, total)))
    assert looked == [(3, 3)]
    assert not partial.exists()
    fresh = select_motions(load_config(own_inputs / "config.yaml"), own_inputs / "fresh")
    np.testing.assert_equal([vars(d) for d in resumed.decisions], [vars(d) for d in fresh.decisions])


def test_a_damaged_selection_is_made_again(own_inputs):
    expected = selected(own_inputs)
    path = own_inputs / "out" / SELECTION_FILE
    path.write_bytes(path.read_bytes()[:200])
    assert len(selected(own_inputs).decisions) == len(expected.decisions)


def test_several_processes_decide_the_same(own_inputs):
    alone = selected(own_inputs)
    shutil.rmtree(own_inputs / "out")
    together = selected(own_inputs, workers=2)
    np.testing.assert_equal([vars(d) for d in together.decisions], [vars(d) for d in alone.decisions])


def test_a_misspelt_licence_is_one_line_with_a_suggestion(own_inputs):
    path = write_config(own_inputs, lambda c: c["selection"].update(licence_allow=["cc00"]))
    with pytest.raises(SettingsError, match=r"cc00.*[Dd]id you mean 'cc0'"):
        load_config(path)
    result = CliRunner().invoke(
        main, ["select", "--config", str(write_config(own_inputs)), "--license-allow", "cc00"]
    )
    assert result.exit_code == 2
    assert "Did you mean 'cc0'?" in result.output


def test_the_command_prints_counts_and_writes_reasons(own_inputs):
    config, out = write_config(own_inputs), own_inputs / "selected"
    result = CliRunner().invoke(
        main, ["select", "--config", str(config), "--out", str(out), "--license-allow", "by,by-nc"]
    )
    assert result.exit_code == 0, result.output
    assert "licence is not allowed" in result.output
    rows = pq.read_table(out / SELECTION_FILE).to_pylist()
    assert Counter(row["rule"] for row in rows) == {"": 4, "licence is not allowed": 2}


@needs_sample
def test_the_whole_sample_passes_the_published_configuration(tmp_path, monkeypatch):
    monkeypatch.setenv("GRASPXL", str(SAMPLE))
    selection = select_motions(load_config("graspxl"), tmp_path)
    assert len(selection.kept) == len(selection.decisions) == 87
