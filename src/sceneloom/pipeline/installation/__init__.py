"""What this installation can do, and what it lacks."""

from sceneloom.pipeline.installation.report import Finding, InstallationReport, Status, examine_installation

__all__ = ["Finding", "InstallationReport", "Status", "examine_installation"]
