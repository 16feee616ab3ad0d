"""Files in and out.  Units and row orders are converted here; inside there is one unit and one order."""

from tomopose.io.calibration_json import read_calibration, write_calibration
from tomopose.io.foreign.pi_gcs import read_gcs_log
from tomopose.io.foreign.reading import read_pose_log, read_scanner_draft
from tomopose.io.images import ImageSequence, RawLayout, open_images, write_hdf5, write_tiff
from tomopose.io.matrices_npz import read_matrices, write_matrices
from tomopose.io.notices import InputWarning
from tomopose.io.observations_csv import read_observations, write_observations
from tomopose.io.pairing import pair_images
from tomopose.io.poses_csv import read_poses
from tomopose.io.poses_csv_writing import write_poses
from tomopose.io.scanner_json import read_scanner, write_scanner

__all__ = [
    "ImageSequence",
    "InputWarning",
    "RawLayout",
    "open_images",
    "pair_images",
    "read_calibration",
    "read_gcs_log",
    "read_matrices",
    "read_observations",
    "read_pose_log",
    "read_poses",
    "read_scanner",
    "read_scanner_draft",
    "write_calibration",
    "write_hdf5",
    "write_matrices",
    "write_observations",
    "write_poses",
    "write_scanner",
    "write_tiff",
]
