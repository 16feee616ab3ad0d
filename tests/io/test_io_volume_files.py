"""Volumes come back as they went, and other programs see them at the same place."""

from __future__ import annotations

import os

import h5py
import numpy as np
import pytest

from tomopose.engines import rtk
from tomopose.errors import FileError, SchemaVersionError
from tomopose.io.volume_files import read_volume, write_volume
from tomopose.provenance import provenance
from tomopose.volume import Volume, VoxelGrid

SUFFIXES = (".h5", ".tif", ".nrrd", ".mhd")


@pytest.fixture
def volume(rng):
    grid = VoxelGrid(shape=(5, 4, 7), spacing=np.array([0.1, 0.2, 0.3]), centre=np.array([1.0, -2.0, 3.5]))
    # a strided view, as reconstruction gives it
    values = rng.random((7, 4, 5)).astype(np.float32).transpose(2, 1, 0)
    return Volume(
        values=values,
        grid=grid,
        view_residual=np.array([0.01, 0.02]),
        notes=("short scan",),
        settings={"algorithm": "sart"},
        provenance=provenance(arguments={"a": 1}, seed=3),
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_values_and_geometry_return(suffix, volume, tmp_path):
    path = write_volume(tmp_path / f"v{suffix}", volume)
    found = read_volume(path)
    assert np.array_equal(found.values, volume.values)
    assert found.values.dtype == np.float32
    assert found.grid.shape == volume.grid.shape
    assert np.allclose(found.grid.spacing, volume.grid.spacing, rtol=0, atol=1e-12)
    assert np.allclose(found.grid.origin, volume.grid.origin, rtol=0, atol=1e-12)


def test_hdf5_keeps_all_that_a_volume_knows(volume, tmp_path):
    path = write_volume(tmp_path / "v.h5", volume)
    found = read_volume(path)
    assert found.notes == ("short scan",)
    assert found.settings == {"algorithm": "sart"}
    assert np.array_equal(found.view_residual, [0.01, 0.02])
    assert found.provenance is not None
    assert found.provenance.seed == 3
    with h5py.File(path) as file:
        assert file["volume"].attrs["frame"] == "W"
        assert np.allclose(file["volume"].attrs["spacing_mm"], [0.1, 0.2, 0.3])


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.parametrize("suffix", [".nrrd", ".mhd"])
def test_itk_sees_the_same_place(suffix, volume, tmp_path):
    if not rtk.availability().available:
        pytest.skip(rtk.availability().reason)
    itk, _ = rtk.load_itk()
    image = itk.imread(str(write_volume(tmp_path / f"v{suffix}", volume)))
    assert np.allclose(list(image.GetOrigin()), volume.grid.origin, atol=1e-12)
    assert np.allclose(list(image.GetSpacing()), volume.grid.spacing, atol=1e-12)
    assert np.allclose(itk.array_from_matrix(image.GetDirection()), np.eye(3))
    assert np.array_equal(itk.array_from_image(image), volume.values)


def test_nothing_is_overwritten_unasked(volume, tmp_path):
    path = write_volume(tmp_path / "v.mhd", volume)
    with pytest.raises(FileError, match="exists already"):
        write_volume(path, volume)
    write_volume(path, volume, force=True)
    assert sorted(os.listdir(tmp_path)) == ["v.mhd", "v.raw"]


def test_bad_files_are_named(volume, tmp_path):
    with pytest.raises(FileError, match="no volume format"):
        write_volume(tmp_path / "v.vol", volume)
    with pytest.raises(FileError, match="does not exist"):
        read_volume(tmp_path / "absent.h5")
    (tmp_path / "broken.h5").write_bytes(b"nothing of the kind")
    with pytest.raises(FileError, match="no readable HDF5 file"):
        read_volume(tmp_path / "broken.h5")
    path = write_volume(tmp_path / "other.h5", volume)
    with h5py.File(path, "a") as file:
        file.attrs["schema"] = "tomopose/volume/2"
    with pytest.raises(SchemaVersionError, match="tomopose/volume/2"):
        read_volume(path)
    whole = write_volume(tmp_path / "cut.nrrd", volume).read_bytes()
    (tmp_path / "cut.nrrd").write_bytes(whole[:-40])
    with pytest.raises(FileError, match="do not fit its"):
        read_volume(tmp_path / "cut.nrrd")


def test_the_earlier_order_of_arguments_is_named_and_still_writes(volume, tmp_path):
    with pytest.warns(DeprecationWarning, match=r"write_volume\(path, volume\) is the order now"):
        path = write_volume(volume, tmp_path / "v.h5")
    assert read_volume(path).grid.same_as(volume.grid)
