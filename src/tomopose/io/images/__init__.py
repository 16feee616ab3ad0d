"""Radiographs from files: lazily, as image[v, u]."""

from tomopose.io.images.formats.raw import RawLayout
from tomopose.io.images.opening import open_images
from tomopose.io.images.sequence import ImageSequence
from tomopose.io.images.writing import write_hdf5, write_tiff

__all__ = ["ImageSequence", "RawLayout", "open_images", "write_hdf5", "write_tiff"]
