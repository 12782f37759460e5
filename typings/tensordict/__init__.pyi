"""What Poise uses of tensordict, which rsl_rl brings and nothing else needs."""

from torch import Tensor

class TensorDict:
    def __getitem__(self, key: str) -> Tensor: ...
