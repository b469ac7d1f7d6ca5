"""Stored laws: whatever is damaged, mixed or edited is refused in one line, and never reaches compiled code."""

import hashlib
import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from adversarial_laws import edited
from plants import box, double_integrator

from mpc import ExplicitMPC, InputError, LinearMPC


def law_of(horizon):
    A, B = double_integrator()
    return LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=horizon, X=box([5, 5]), U=box([1])).explicit()


@pytest.fixture(scope="module")
def law():
    return law_of(4)


def rewrite(folder, change, text_change=None):
    """Edit arrays, or the manifest, and fingerprint the result anew: an edit that the fingerprint does not betray."""
    with np.load(folder / "law.npz") as file:
        data = {name: file[name] for name in file.files}
    change(data)
    text = json.loads((folder / "law.json").read_text()) | (text_change or {})
    del text["fingerprint"]
    digest = hashlib.sha256(json.dumps(text, sort_keys=True).encode())
    for name in sorted(data):
        array = np.ascontiguousarray(data[name])
        digest.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    text["fingerprint"] = digest.hexdigest()
    np.savez(folder / "law.npz", **data)
    (folder / "law.json").write_text(json.dumps(text))


def test_the_manifest_of_one_law_with_the_arrays_of_another_is_refused(law, tmp_path):
    law.save(tmp_path / "law")
    law_of(5).save(tmp_path / "other")
    (tmp_path / "law.npz").write_bytes((tmp_path / "other.npz").read_bytes())
    with pytest.raises(InputError, match=r"law.npz is not the file that law.json was written with"):
        ExplicitMPC.load(tmp_path / "law")


def set_to(name, index, value):
    def change(data):
        array = data[name].copy()
        array[index] = value
        data[name] = array

    return change


def cut(name, count):
    return lambda data: data.update({name: data[name][:count]})


EDITS = {
    "a child that does not exist": set_to("tree_nodes", (0, 1), 10**6),
    "a cycle": set_to("tree_nodes", (0, 1), 0),
    "a negative child": set_to("tree_nodes", (0, 2), -5),
    "a hyperplane that does not exist": set_to("tree_nodes", (0, 0), 10**6),
    "a shortened tree": cut("tree_nodes", 3),
    "an empty tree": cut("tree_nodes", 0),
    "shortened hyperplanes": cut("tree_planes", 1),
    "shortened leaves": cut("tree_leaf_regions", 2),
    "a region that does not exist": set_to("tree_leaf_regions", 0, 10**6),
    "a negative region": set_to("tree_leaf_regions", 0, -1),
    "offsets beyond the facets": set_to("partition_offsets", -1, 10**6),
    "offsets that decrease": set_to("partition_offsets", 1, -3),
    "shortened facets": cut("partition_H", 3),
    "a law less": cut("law", 3),
    "a law number too large": set_to("law_number", 0, 10**6),
    "a negative law number": set_to("law_number", 0, -2),
    "NaN in a law": set_to("law", (0, 0, 0), np.nan),
    "infinity in a hyperplane": set_to("tree_planes", (0, 0), np.inf),
    "a member that is no constraint": set_to("members", 0, 10**6),
    "a negative count of members": set_to("member_counts", 0, -1),
    "half a width of zero": set_to("partition_half", 0, 0.0),
    "numbers as text": lambda data: data.update(tree_nodes=data["tree_nodes"].astype(str)),
    "nodes as floats": lambda data: data.update(tree_nodes=data["tree_nodes"].astype(float)),
    "a missing array": lambda data: data.pop("tree_border"),
}


@pytest.mark.parametrize("edit", EDITS)
def test_edited_arrays_are_refused(law, edit, tmp_path):
    law.save(tmp_path / "law")
    rewrite(tmp_path, EDITS[edit])
    with pytest.raises(InputError, match=r"path: got law.json and law.npz that cannot be read"):
        ExplicitMPC.load(tmp_path / "law")


@pytest.mark.parametrize(
    "change",
    [{"regions": 7}, {"regions": "many"}, {"nu": 0}, {"nu": 9}, {"labels": []}, {"status": "DONE"}, {"parameters": 3},
     {"tree_status": None}, {"constant_cost": "free"}, {"parameters": [["x", 5]]}, {"labels": [[1]] * 24}],
)  # fmt: skip
def test_edited_manifests_are_refused(law, change, tmp_path):
    law.save(tmp_path / "law")
    rewrite(tmp_path, lambda data: None, change)
    with pytest.raises(InputError, match="cannot be read"):
        ExplicitMPC.load(tmp_path / "law")


def test_missing_files_and_places_that_cannot_be_written_to_are_refused(law, tmp_path):
    with pytest.raises(InputError, match=r"path: got no file .*nothing.json"):
        ExplicitMPC.load(tmp_path / "nothing")
    law.save(tmp_path / "law")
    (tmp_path / "law.npz").unlink()
    with pytest.raises(InputError, match=r"path: got no file .*law.npz"):
        ExplicitMPC.load(tmp_path / "law")
    (tmp_path / "law.npz").mkdir()
    with pytest.raises(InputError, match="path: got no file"):
        ExplicitMPC.load(tmp_path / "law")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="expected a place that can be written to"):
        law.save(tmp_path / "file" / "law")
    for path in (None, 3, ["a"]):
        with pytest.raises(InputError, match="path: got"):
            ExplicitMPC.load(path)
        with pytest.raises(InputError, match="path: got"):
            law.save(path)


def test_forged_files_that_change_nothing_are_read(law, tmp_path):
    law.save(tmp_path / "law")
    rewrite(tmp_path, lambda data: None)
    assert len(ExplicitMPC.load(tmp_path / "law")) == len(law)


@pytest.mark.long
def test_one_byte_edits_are_refused_or_change_nothing(law):
    assert set(edited(law, 200, np.random.default_rng(1))) <= {"refused", "read as it was"}


def test_threads_that_save_to_one_path_leave_a_law(law, tmp_path):
    laws = [law, law_of(3)]
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(lambda i: laws[i % 2].save(tmp_path / "law"), range(24)))
    assert len(ExplicitMPC.load(tmp_path / "law")) in {len(one) for one in laws}
    assert sorted(file.name for file in tmp_path.iterdir()) == ["law.json", "law.npz"]


def test_random_damage_is_refused_or_harmless(law, tmp_path):
    arrays, manifest = law.save(tmp_path / "law")
    rng = np.random.default_rng(0)
    for file in (arrays, manifest):
        content = file.read_bytes()
        for _ in range(40):
            damaged = bytearray(content)
            for position in rng.integers(0, len(content), size=3):
                damaged[position] = rng.integers(0, 256)
            file.write_bytes(damaged)
            try:
                loaded = ExplicitMPC.load(tmp_path / "law")
            except InputError:
                continue
            assert loaded([1.0, 0.5]) == law([1.0, 0.5])
        file.write_bytes(content)
    assert len(ExplicitMPC.load(tmp_path / "law")) == len(law)
