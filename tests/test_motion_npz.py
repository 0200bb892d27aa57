"""Motion and poses as .npz: exact both ways, and nothing in a stranger's file runs, fills memory or passes for motion."""

import contextlib
import io
import pickle
import zipfile
from dataclasses import replace

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest

from kinjax.errors import FileFormatError, OptionError, ShapeError
from kinjax.formats import (
    load,
    npz_container,
    read_bvh,
    read_motion_npz,
    read_poses_npz,
    write_motion_npz,
    write_poses_npz,
)
from kinjax.motion import Motion, Poses, make_poses
from kinjax.skeleton import Skeleton, Topology


def some_motion(batch=(), dtype=np.float64, seed=0) -> Motion:
    rng = np.random.default_rng(seed)
    t = Topology(("Hüfte", "a b"), (-1, 0), (("Xposition", "Zrotation"), ()), (0,), (1, 1), ("", "tip"), "z")
    s = Skeleton(rng.normal(size=(2, 3)).astype(dtype), rng.normal(size=(2, 3)).astype(dtype), t)
    q, p = rng.normal(size=(*batch, 5, 2, 4)).astype(dtype), rng.normal(size=(*batch, 5, 1, 3)).astype(dtype)
    return Motion(p, q, s, 1 / 0.0083333, "clip.bvh", ("one", "two"))


def same(a, b) -> None:
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        assert x.dtype == y.dtype and x.tobytes() == y.tobytes()
    assert jax.tree.structure(a) == jax.tree.structure(b)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_motion_comes_back_bit_for_bit(tmp_path, batch, dtype):
    m = some_motion(batch, dtype)
    m.rotations[..., 1, 0, :] = np.nan  # gaps are kept as they are
    path = write_motion_npz(tmp_path / "m.npz", m)
    same(read_motion_npz(path), m)
    same(load(path), m)
    first = path.read_bytes()
    assert write_motion_npz(path, read_motion_npz(path)).read_bytes() == first  # and no clock in it
    with np.load(path, allow_pickle=False) as plain:  # any NumPy can read it
        np.testing.assert_array_equal(plain["rotations"], m.rotations)


def test_masses_and_limits_come_back_where_they_are_known(tmp_path):
    m, rng = some_motion(), np.random.default_rng(2)
    measures = {"masses": np.array([3.0, 2.0]), "mass_centers": rng.normal(size=(2, 3)), "limits": rng.normal(size=(2, 3, 2))}
    for names in ((), ("limits",), ("masses", "mass_centers"), tuple(measures)):
        known = replace(m, skeleton=replace(m.skeleton, **{n: measures[n] for n in names}))
        back = read_motion_npz(write_motion_npz(tmp_path / "m.npz", known))
        same(back, known)
        assert [n for n in measures if getattr(back.skeleton, n) is not None] == [n for n in measures if n in names]


def test_measures_that_do_not_fit(tmp_path):
    m, path = some_motion(), tmp_path / "m.npz"
    for name, shape in (("masses", (3,)), ("mass_centers", (2,)), ("limits", (2, 2, 3))):
        wrong = replace(m, skeleton=replace(m.skeleton, **{name: np.zeros(shape)}))
        with pytest.raises(ShapeError, match=name):
            write_motion_npz(path, wrong)
        assert not path.exists()
        content = members(write_motion_npz(path, m))
        rewrite(path, {**content, f"{name}.npy": npy(np.zeros(shape))})
        refused(path, name, str(shape))
        rewrite(path, {**content, "weights.npy": npy(np.zeros(2))})
        refused(path, "weights")
        path.unlink()
    with pytest.raises(ShapeError, match="masses is of type int"):
        write_motion_npz(path, replace(m, skeleton=replace(m.skeleton, masses=np.array([3, 2]))))


def test_arrays_of_the_engine(tmp_path, x64):
    m = some_motion()
    m = Motion(jnp.asarray(m.translations), jnp.asarray(m.rotations), m.skeleton, jnp.float32(30.0), m.name)
    back = read_motion_npz(write_motion_npz(tmp_path / "m.npz", m))
    assert isinstance(back.rotations, np.ndarray) and back.rate == 30.0
    np.testing.assert_array_equal(back.rotations, m.rotations)


def test_a_real_motion(tmp_path, data):
    m = read_bvh(data / "bvh/exporters/walk01.bvh")
    same(read_motion_npz(write_motion_npz(tmp_path / "m.npz", m)), m)


def test_poses_come_back_bit_for_bit(tmp_path):
    rng = np.random.default_rng(1)
    q = rng.normal(size=(2, 6, 3, 4))
    p = rng.normal(size=(2, 6, 3, 3))
    p[0, 2, 1] = np.nan
    poses = make_poses(["a", "b", "c"], q / np.linalg.norm(q, axis=-1, keepdims=True), p, 59.94, clip="x.c3d", up="z")
    path = write_poses_npz(tmp_path / "p.npz", poses)
    same(read_poses_npz(path), poses)
    with pytest.raises(FileFormatError, match=r"kinjax-poses/1.*kinjax-motion/1"):
        read_motion_npz(path)


def test_what_does_not_fit_is_not_written(tmp_path):
    m = some_motion()
    with pytest.raises(ShapeError, match="shapes"):
        write_motion_npz(tmp_path / "m.npz", Motion(m.translations[1:], m.rotations, m.skeleton, 30.0))
    with pytest.raises(ShapeError, match="rotations is of type int"):
        write_motion_npz(tmp_path / "m.npz", Motion(m.translations, np.zeros((5, 2, 4), int), m.skeleton, 30.0))
    for rate in (0.0, float("nan"), -1.0):
        with pytest.raises(OptionError, match="rate"):
            write_motion_npz(tmp_path / "m.npz", Motion(m.translations, m.rotations, m.skeleton, rate))
    poses = Poses(np.zeros((5, 1, 4)), np.zeros((5, 1, 3)), np.ones((5, 1), bool), 30.0, ("a", "b"))
    with pytest.raises(ShapeError, match="2 names"):
        write_poses_npz(tmp_path / "m.npz", poses)
    assert not list(tmp_path.iterdir())


# Strangers' files


def members(path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as z:
        return {n: z.read(n) for n in z.namelist()}


def rewrite(path, content: dict[str, bytes], method=zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", method) as z:
        for name, data in content.items():
            z.writestr(name, data)


def npy(array, **kw) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array(out, array, **kw)
    return out.getvalue()


def refused(path, *parts: str) -> None:
    with pytest.raises(FileFormatError) as e:
        read_motion_npz(path)
    assert e.value.remedy and str(path) in str(e.value) and all(p in str(e.value) for p in parts), str(e.value)


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was run",))


def test_pickles_are_never_run(tmp_path):
    path = write_motion_npz(tmp_path / "m.npz", some_motion())
    content = members(path)
    for name in ("rotations.npy", "meta.npy", "extra.npy"):
        rewrite(path, {**content, name: npy(np.array([Bomb()], object), allow_pickle=True)})
        refused(path, "Python objects", "pickle")
    path.write_bytes(pickle.dumps(Bomb()))
    refused(path, "no readable .npz")
    np.save(tmp_path / "m.npy", np.zeros(3))
    (tmp_path / "m.npy").rename(path)
    refused(path, "no readable .npz")


def test_zip_bombs_are_refused_before_they_unpack(tmp_path, monkeypatch):
    path = write_motion_npz(tmp_path / "m.npz", some_motion())
    content = members(path)
    rewrite(path, {**content, "rotations.npy": npy(np.zeros(4 << 20))}, zipfile.ZIP_DEFLATED)
    refused(path, "times its size")
    rewrite(path, {**content, **{f"x{i}.npy": b"" for i in range(100)}})
    refused(path, "members")
    rewrite(path, content, zipfile.ZIP_LZMA)
    refused(path, "packed in another way")
    rewrite(path, content)
    monkeypatch.setattr(npz_container, "MEMBER_BYTES", 100)
    refused(path, "claims")


def test_headers_that_claim_more_than_is_there(tmp_path):
    path = write_motion_npz(tmp_path / "m.npz", some_motion())
    content = members(path)
    whole = content["rotations.npy"]
    shape = b"(5, 2, 4)"
    for old, new in ((shape, b"(9999999999, 2, 4)"), (shape, b"(-5, 2, -4)"), (shape, b"(5, 2, 5)"), (b"<f8", b"<c8")):
        header = whole.replace(old, new)
        header = header.replace(b" " * (len(header) - len(whole)) + b"\n", b"\n", 1) if len(header) > len(whole) else header
        rewrite(path, {**content, "rotations.npy": header})
        refused(path, "rotations")
    for broken in (b"", b"\x93NUMPY", whole[:40], b"x" * 200, whole[:-1], whole + b"\x00"):
        rewrite(path, {**content, "rotations.npy": broken})
        refused(path, "rotations")


def test_other_versions_and_wrong_descriptions(tmp_path):
    path = write_motion_npz(tmp_path / "m.npz", some_motion())
    content = members(path)
    meta = msgspec.json.decode(np.load(io.BytesIO(content["meta.npy"])).tobytes())

    def with_meta(**changes):
        document = msgspec.json.encode({k: v for k, v in {**meta, **changes}.items() if v is not ...})
        rewrite(path, {**content, "meta.npy": npy(np.frombuffer(document, np.uint8))})

    with_meta(schema="kinjax-motion/2")
    refused(path, "kinjax-motion/2", "update")
    with_meta(schema=None)
    refused(path, "does not say")
    wrong = {"rate": 0, "parents": [-1, 5], "names": ["a", "a"], "up": "w", "translated": [7], "end_parents": [9, 9]}
    for key, value in (wrong | {"more": 1, "notes": ...}).items():
        with_meta(**{key: value})
        refused(path)
    rewrite(path, {**content, "meta.npy": npy(np.frombuffer(b"[" * 100_000, np.uint8))})
    refused(path, "JSON")
    rewrite(path, {k: v for k, v in content.items() if k != "meta.npy"})
    refused(path, "without a description")
    rewrite(path, {k: v for k, v in content.items() if k != "offsets.npy"})
    refused(path, "offsets")


def test_damage_anywhere_is_seen(tmp_path):
    path = write_motion_npz(tmp_path / "m.npz", some_motion())
    whole, good = path.read_bytes(), read_motion_npz(path)
    for cut in range(0, len(whole), 37):
        path.write_bytes(whole[:cut])
        refused(path)
    for at in range(0, len(whole), 23):  # one flipped byte: refused (checksums), or in a field that nothing depends on
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        with contextlib.suppress(FileFormatError):
            same(read_motion_npz(path), good)
