"""`tomopose plan poses` and `tomopose plan scan`: what to image, before anything is imaged."""

from __future__ import annotations

import typer

from tomopose.cli import plan_poses, plan_scan
from tomopose.cli.options import add_command

app_plan = typer.Typer(no_args_is_help=True, rich_markup_mode="rich", help="Plan calibration poses and scans.")


def register(app: typer.Typer) -> None:
    add_command(app_plan, "poses", plan_poses.poses, epilog=plan_poses.EPILOG)
    add_command(app_plan, "scan", plan_scan.scan, epilog=plan_scan.EPILOG)
    app.add_typer(app_plan, name="plan")
