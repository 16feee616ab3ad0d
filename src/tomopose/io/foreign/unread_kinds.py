"""Kinds of files that are not read: recognised by their mark or their ending, and answered with how to proceed."""

from __future__ import annotations

from collections.abc import Mapping

from tomopose.io.foreign.foreign_file import ForeignFile

MARKS: tuple[tuple[bytes, str, str], ...] = (
    (b"\x89PNG", "a PNG picture", "export the detector's 16-bit data as TIFF"),
    (b"\xff\xd8\xff", "a JPEG picture", "export the detector's 16-bit data as TIFF"),
    (b"%PDF", "a PDF document", "type the numbers that it shows into scanner.json"),
    (b"{\\rtf", "an RTF document", "save it as plain text, or type its numbers into scanner.json"),
    (b"VMS.XI", "a Varian image (.xim)", "images go to --images of detect and calibrate"),
    (b"II*\0", "a TIFF image", "images go to --images of detect and calibrate"),
    (b"MM\0*", "a TIFF image", "images go to --images of detect and calibrate"),
    (b"\x89HDF", "an HDF5 file without an NXtomo entry", "its images go to --images with --dataset NAME"),
    (b"PK\x03\x04", "a ZIP archive or an office document", "save the sheet as CSV UTF-8, or unpack the archive"),
    (b"\xd0\xcf\x11\xe0", "an OLE container (Zeiss .txrm, or an old office document)", "save a sheet as CSV UTF-8"),
    (b"\x1f\x8b", "a gzip archive", "unpack it"),
    (b"\x93NUMPY", "a NumPy array", "(n, 4, 4) are poses, (n, 3, 4) and (n, 12) geometry: import-geometry"),
    (b"solid", "an STL mesh", "meshes go to `plan scan --part` and to measurement plans"),
)
ENDINGS: Mapping[str, tuple[str, str]] = {
    ".vgi": ("a VGSTUDIO volume description", "it describes a volume; export the projections' geometry instead"),
    ".vgl": ("a VGSTUDIO project", "export the projections' geometry from the scanner's own software"),
    ".pcr": ("a phoenix reconstruction description", "the scan's .pca beside it holds the geometry: import-scanner"),
    ".xtekvolume": ("a Nikon volume description", "the scan's .xtekct holds the geometry: import-scanner"),
    ".xtek2dct": ("a Nikon 2D scan description", "the scan's .xtekct holds the geometry: import-scanner"),
    ".xim": ("a Varian image", "images go to --images of detect and calibrate"),
    ".hnc": ("a Varian image", "convert the images to TIFF with the maker's tools"),
    ".his": ("a Perkin Elmer or Varex image", "read it as RAW: --raw NVxNU:<u2:100"),
    ".seq": ("a detector sequence", "export the frames as TIFF"),
    ".rek": ("an EZRT image", "export the frames as TIFF"),
    ".raw": ("RAW pixels", "images go to --images with --raw NVxNU:TYPE"),
    ".xlsx": ("a spreadsheet", "save it as CSV UTF-8 and import that"),
    ".xls": ("a spreadsheet", "save it as CSV UTF-8 and import that"),
    ".ods": ("a spreadsheet", "save it as CSV UTF-8 and import that"),
    ".mat": ("a MATLAB file", "projection matrices in it are read by import-geometry; save poses as CSV"),
    ".stp": ("a STEP model", "models go to `plan scan --part`, as STL"),
    ".step": ("a STEP model", "models go to `plan scan --part`, as STL"),
    ".tp": ("a FANUC binary program", "save it as a listing (.ls) on the controller"),
    ".pgx": ("a Staubli program", "the points are in the .dtx beside it: import that"),
    ".jpg": ("a JPEG picture", "export the detector's 16-bit data as TIFF"),
}
NEXT: Mapping[str, str] = {
    "poses": (
        "write the poses as a table with a header (x_mm, y_mm, z_mm and the machine's angles) and say whose angles "
        "they "
        "are: tomopose import-poses FILE --convention kuka --columns x=..,y=..,z=..,a=..,b=..,c=.. --out poses.csv"
    ),
    "scanner": (
        "write what you know as lines `d_SD_mm = 1200`, `d_SR_mm = ...`, `p_u_mm`, `p_v_mm`, `n_u_px`, `n_v_px` into a "
        "text file: tomopose import-scanner FILE --out scanner.json"
    ),
    "geometry": (
        "write the 3 x 4 matrices as twelve numbers a row: tomopose import-geometry FILE --n-u-px N --n-v-px N "
        "--p-u-mm X "
        "--p-v-mm X --rows top --out matrices.npz"
    ),
    "images": "export the frames as 16-bit TIFF, HDF5 or RAW",
}


def likely_kind(file: ForeignFile, wanted: str) -> str:
    """What a file of no known kind likely is, and how to proceed."""
    if not file.head:
        return "the file is empty (0 bytes); copy it again"
    for mark, what, way in MARKS:
        if file.head.startswith(mark):
            return f"this is {what}, which holds no {wanted} that can be read; {way}"
    if file.suffix in ENDINGS:
        what, way = ENDINGS[file.suffix]
        return f"by its name this is {what}, which holds no {wanted} that can be read; {way}"
    if not file.is_text:
        return f"this is a binary file of an unknown kind; {NEXT[wanted]}"
    first = next((line.strip() for line in file.lines if line.strip()), "")
    return f"this is text of an unknown kind (it begins with {first[:40]!r}); {NEXT[wanted]}"
