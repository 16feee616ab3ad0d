"""Findings, alternatives, stability and model comparison of a calibration, as calibration.json holds them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from tomopose.calibration.checks.conventions.hypothesis import Hypothesis
from tomopose.calibration.checks.stability import Effect, OutlierBlock, RepeatedPose, Stability
from tomopose.calibration.checks.verdict import Finding
from tomopose.calibration.result import (
    ModelComparison,
    ModelJudgement,
    PoseNoiseFound,
    RotationResiduals,
    ViewDistances,
)
from tomopose.io.numbers_json import decode_array, encode


def flat(value: Any) -> dict[str, Any]:
    """A dataclass of numbers and text by its fields' names."""
    row = {f.name: getattr(value, f.name) for f in fields(value)}
    return {name: encode(v) if isinstance(v, float) else v for name, v in row.items()}


def number(value: object) -> float:
    """A number as `encode` writes it."""
    return float(decode_array(value))


def finding_document(f: Finding) -> dict[str, Any]:
    return {
        "rule": f.rule,
        "value": encode(f.value),
        "limit": encode(f.limit),
        "words": f.words,
        "cure": f.remedy,
        "verdict": f.verdict,
    }


def finding_from(row: Mapping[str, Any]) -> Finding:
    return Finding(
        rule=row["rule"],
        value=number(row["value"]),
        limit=number(row["limit"]),
        words=row["words"],
        remedy=row["cure"],
        verdict=row["verdict"],
    )


def hypothesis_document(h: Hypothesis) -> dict[str, Any]:
    return {name: encode(v) if isinstance(v, float) else v for name, v in h.to_json().items()}


def hypothesis_from(row: Mapping[str, Any]) -> Hypothesis:
    return Hypothesis(
        name=row["name"],
        words=row.get("words", ""),
        remedy=row.get("cure", ""),
        d_rms=number(row.get("d_rms_px")),
        chi2=number(row.get("chi2")),
        dof=int(row.get("dof", 0)),
        sigmas=number(row.get("sigmas")),
        delta=number(row.get("delta_chi2")),
        factor=number(row.get("factor")),
        outcome=row.get("outcome", "worse"),
        symmetry=bool(row.get("symmetry", False)),
        length_factor=number(row.get("length_factor", 1.0)),
        ball_mm=number(row.get("ball_mm", 0.0)),
        d_SR=number(row.get("d_SR_mm", 0.0)),
        possible=bool(row.get("possible", True)),
        share=number(row.get("share", 0.0)),
        size_ratio=number(row.get("size_ratio")),
    )


def stability_document(s: Stability) -> dict[str, Any]:
    return {
        "effects": [flat(e) for e in s.effects],
        "repeats": [flat(r) for r in s.repeats],
        "outlier_block": None if s.block is None else flat(s.block),
        "held_out_rms_px": encode(s.held_out_rms),
        "held_out_chi2": encode(s.held_out_chi2),
        "fit_rms_px": encode(s.fit_rms),
    }


def stability_from(row: Mapping[str, Any]) -> Stability:
    block = row.get("outlier_block")
    return Stability(
        effects=tuple(
            Effect(
                name=e["name"],
                p=number(e["p"]),
                size_px=number(e["size_px"]),
                share=number(e["share"]),
                words=e["words"],
                at=e["at"],
            )
            for e in row["effects"]
        ),
        repeats=tuple(
            RepeatedPose(
                first=r["first"], again=r["again"], distance_px=number(r["distance_px"]), sigmas=number(r["sigmas"])
            )
            for r in row["repeats"]
        ),
        block=None
        if block is None
        else OutlierBlock(first=block["first"], last=block["last"], count=int(block["count"]), p=number(block["p"])),
        held_out_rms=number(row["held_out_rms_px"]),
        held_out_chi2=number(row["held_out_chi2"]),
        fit_rms=number(row["fit_rms_px"]),
    )


def comparison_document(c: ModelComparison) -> dict[str, Any]:
    names = {"cv_rms": "cv_rms_px", "d_rms": "d_rms_px"}
    return {
        "chosen": c.chosen,
        "models": [{names.get(name, name): v for name, v in flat(m).items()} for m in c.models],
        "by_rotation": [
            {
                "rotation": row.rotation,
                "n": row.n,
                **{f"{model}_px": encode(v) for model, v in row.px.items()},
                **{f"{model}_um": encode(v) for model, v in row.um.items()},
            }
            for row in c.by_rotation
        ],
    }


def comparison_from(row: Mapping[str, Any]) -> ModelComparison:
    return ModelComparison(
        chosen=row["chosen"],
        models=tuple(
            ModelJudgement(
                model=m["model"],
                log_evidence=number(m["log_evidence"]),
                log_predictive=number(m["log_predictive"]),
                cv_rms=number(m["cv_rms_px"]),
                cv_chi2=number(m["cv_chi2"]),
                d_rms=number(m["d_rms_px"]),
                chi2_dof=number(m["chi2_dof"]),
                scatter=number(m["scatter"]),
                size=number(m["size"]),
            )
            for m in row["models"]
        ),
        by_rotation=tuple(
            RotationResiduals(
                rotation=r["rotation"],
                n=int(r["n"]),
                px={k.removesuffix("_px"): number(v) for k, v in r.items() if k.endswith("_px")},
                um={k.removesuffix("_um"): number(v) for k, v in r.items() if k.endswith("_um")},
            )
            for r in row["by_rotation"]
        ),
    )


def pose_noise_from(row: Mapping[str, object]) -> PoseNoiseFound:
    values = {f.name: number(row[f.name]) for f in fields(PoseNoiseFound) if f.name != "found"}
    return PoseNoiseFound(**values, found=bool(row.get("found", True)))


def views_document(v: ViewDistances) -> dict[str, Any]:
    return {"sigma_mm": v.sigma, "pose_id": list(v.pose_id), "d_SD_mm": encode(v.d_SD), "u_mm": encode(v.u)}


def views_from(row: Mapping[str, Any]) -> ViewDistances:
    n = len(row["pose_id"])
    return ViewDistances(
        sigma=float(row["sigma_mm"]),
        pose_id=tuple(row["pose_id"]),
        d_SD=decode_array(row["d_SD_mm"], n),
        u=decode_array(row["u_mm"], n),
    )
