"""Whether the estimate may be trusted: consistency, contradictions, motion of the target."""
