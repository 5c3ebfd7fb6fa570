"""The frozen base of all parameter records.

Every package declares its own parameters as a subclass; `companion.config` composes them and
reads them from YAML, so defaults and bounds live in one place, beside the code that uses them.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0.0)]


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A frozen parameter record that refuses keys it does not know."""
