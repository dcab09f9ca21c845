# MuJoCo is a compiled module whose types pyright cannot read: whatever is asked of it exists.
from typing import Any

def __getattr__(name: str) -> Any: ...
