"""LayerNorm: its gradients do not depend on the number of threads; as an activation for SB3."""

from __future__ import annotations

from typing import Any

import torch as th
from torch import nn

from ..common.torch_helpers import threads_at


class LayerNorm(nn.LayerNorm):
    """LayerNorm with the gradients of one thread, whatever the number of threads.

    PyTorch's own adds up the gradients of weight and bias in as many parts as there are threads: of
    an update's operations the one whose last bits depend on their number. On the CPU these two
    sums are left to one thread; all else is shared out as ever.
    """

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Normalise the last dimension of a batch, in the shape that it has."""
        learns = th.is_grad_enabled() and self.weight.requires_grad
        if not learns or x.device.type != "cpu" or th.get_num_threads() == 1:
            return super().forward(x)
        y: th.Tensor = _LayerNorm.apply(x, self.normalized_shape, self.weight, self.bias, self.eps)
        return y


class LayerNormReLU(nn.Module):
    """ReLU of standardised inputs: brings LayerNorm into any network of SB3, as its activation_fn.

    It has no weights, so it needs no widths: SB3 makes activations without arguments.
    """

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Standardise each row of (n, width) and cut off what is below its mean."""
        return th.relu(nn.functional.layer_norm(x, (int(x.shape[-1]),)))


class _LayerNorm(th.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: th.Tensor,
        shape: tuple[int, ...],
        weight: th.Tensor,
        bias: th.Tensor,
        eps: float,
    ) -> th.Tensor:
        y, mean, rstd = th.native_layer_norm(x, shape, weight, bias, eps)
        ctx.save_for_backward(x, mean, rstd, weight, bias)
        ctx.shape = shape
        return y

    @staticmethod
    def backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:
        x, mean, rstd, weight, bias = ctx.saved_tensors

        def gradients(*wanted: bool) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
            return th.ops.aten.native_layer_norm_backward(
                grad, x, ctx.shape, mean, rstd, weight, bias, wanted
            )

        of_x = gradients(True, False, False)[0] if ctx.needs_input_grad[0] else None
        with threads_at(1):
            _, of_weight, of_bias = gradients(False, True, True)
        return of_x, None, of_weight, of_bias, None
