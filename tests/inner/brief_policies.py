"""First policies in a few steps."""

from ccdtools.co_design.imitation import policy_from_scratch
from learning import CloningConfig


def shorten(monkeypatch):
    """Clone, and train from scratch, in a few steps by default."""
    monkeypatch.setattr(CloningConfig.__init__, "__defaults__", (300, 256, 4e-3))
    monkeypatch.setitem(policy_from_scratch.__kwdefaults__, "updates", 10)
