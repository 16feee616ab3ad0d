"""calibration.json of schema 1, translated to schema 2: it loads for ever."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tomopose.geometry.scanner import PARAMETER_UNITS

MODEL_KEYS = {"cv_rms_px": "cv_rms", "d_rms_px": "d_rms"}


def as_version_2(document: Mapping[str, Any]) -> Mapping[str, Any]:
    """The document as schema 2 has it; one of schema 2 is given back as it is.

    A verdict of schema 1 came with sentences and without findings: each becomes a finding of the rule "recorded".
    """
    if document["schema"] != "tomopose/calibration/1":
        return document
    extra, block = document["extra"], document["manipulator"]
    twin, moving = block.get("kind") == "twin", block.get("arrangement") == "moving-scanner"
    views = extra.get("view_d_SD")
    if views is not None:
        views = {"sigma_mm": block["view_sigma"]["d_SD"], **views}
    priors = _priors(document)
    return {
        **document,
        "findings": _findings(document),
        "arrangement": "twin"
        if twin
        else "moving-scanner"
        if moving or block.get("kind") == "inverse"
        else "moving-object",
        "priors": priors,
        "assumed": [
            {"name": name, "sigma": sigma, "unit": PARAMETER_UNITS[name], "from": "scanner.json"}
            for name, sigma in priors.items()
            if name in PARAMETER_UNITS and sigma != "inf"
        ],
        "not_seen": extra.get("not_seen", {}),
        "widening": extra.get("widening", 1.0),
        "expected_residual_px": extra.get("expected_residual_px"),
        "pose_noise": extra.get("pose_noise"),
        "manipulator": _manipulator(block, extra.get("pose_noise")),
        "stability": extra.get("integrity"),
        "comparison": _comparison(extra),
        "views": views,
        "runs": [_run(document["scanner"], run) for run in extra.get("runs", ())],
    }


def _findings(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    words = document["reasons"] or ([document["status"]] if document["verdict"] != "trustworthy" else [])
    blank = {"rule": "recorded", "value": None, "limit": None, "cure": ""}
    return [{**blank, "words": w, "verdict": document["verdict"]} for w in words]


def _priors(document: Mapping[str, Any]) -> dict[str, Any]:
    """Freed parameter -> prior standard deviation, "inf" where it had none: from the arguments and the scanner."""
    arguments = (document.get("provenance") or {}).get("arguments", {})
    units = {f"{name}_{unit}": name for name, unit in PARAMETER_UNITS.items()}
    stated = {units.get(key, key): sigma for key, sigma in (document["scanner"].get("sigma") or {}).items()}
    given = arguments.get("priors")
    stated |= given if isinstance(given, Mapping) else {}
    known = {*PARAMETER_UNITS, "pitch_ratio", "translation_scale"}
    names = [name for name in document["covariance"]["names"] if name.split("[")[0] in known]
    return {name: stated.get(name.split("[")[0], "inf") for name in names}


def _manipulator(block: Mapping[str, object], noise: Mapping[str, object] | None) -> dict[str, Any]:
    if "scatter" in block or noise is None:
        return dict(block)
    about_plate = {"t_mm": [noise["translation_mm"]] * 3, "w_rad": [noise["rotation_rad"]] * 3, "about": "plate"}
    return {**block, "scatter": about_plate}


def _comparison(extra: Mapping[str, object]) -> dict[str, Any] | None:
    if not extra.get("models"):
        return None
    return {
        "models": extra["models"],
        "chosen": extra.get("model_chosen", ""),
        "by_rotation": extra.get("by_rotation", []),
    }


def _run(scanner: Mapping[str, object], values: Mapping[str, object]) -> dict[str, Any]:
    """The scanner of one of several runs: schema 1 kept its parameters without their units."""
    own = {f"{name}_{unit}": values[name] for name, unit in PARAMETER_UNITS.items() if name in values}
    return {**scanner, **own}
