"""``cldof doctor``: what the product needs, whether it is here, and whether each device makes the right pictures."""

from .report import Finding, Report, examine

__all__ = ["Finding", "Report", "examine"]
