"""Lab 8: wrong solutions that students write.

Each must lose points and be seen by a public check.
"""

MUTANTS = {
    "history_window": (
        (
            "the frame's own command is in its row",
            "history[first + column + 1 : last, column] = commands[first : last - column - 1]",
            "history[first + column : last, column] = commands[first : last - column]",
        ),
        (
            "flights leak into each other",
            "for first, last in zip(starts, ends, strict=True):",
            "for first, last in [(0, len(commands))]:",
        ),
        ("oldest first", "return history\n", "return history[:, ::-1].copy()\n"),
        ("one column too few", "range(min(k, last - first))", "range(min(k, last - first) - 1)"),
        (
            "the last flight is forgotten",
            "[*starts[1:], len(commands)]",
            "[*starts[1:], starts[-1]]",
        ),
        (
            "short flights break by negative slices",
            "range(min(k, last - first))",
            "range(k if last - first > 3 else 1)",
        ),
    ),
    "make_dataset": (
        (
            "reshape for transpose",
            ".transpose(0, 3, 1, 2)",
            ".reshape(len(images), 3, *images.shape[1:3])",
        ),
        ("0..1 in place of -1..1", "- 127.5) / 127.5", ") / 255.0"),
        ("mirrored upside down", "pictures[:, :, :, ::-1]", "pictures[:, :, ::-1]"),
        ("colours mirrored", "pictures[:, :, :, ::-1]", "pictures[:, ::-1]"),
        ("labels keep their sign", "[labels, -labels]", "[labels, labels]"),
        ("history keeps its sign", "[history, -history]", "[history, history]"),
        ("width before height", ".transpose(0, 3, 1, 2)", ".transpose(0, 3, 2, 1)"),
        (
            "mirrored ones replace the others",
            "np.concatenate([pictures, flipped])",
            "np.concatenate([flipped, flipped])",
        ),
        (
            "8-bit arithmetic",
            "images.astype(np.float32)",
            "np.uint8(images + np.uint8(0)) * np.uint8(2)",
        ),
    ),
    "bc_loss_step": (
        ("turns weigh nothing", "(1.0 + TURN_WEIGHT * labels.abs()) * ", ""),
        ("right turns only", "labels.abs()", "labels"),
        ("gradients add up", "    optimiser.zero_grad()\n", "    pass\n"),
        (
            "no clipping",
            "    torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP_NORM)\n",
            "    pass\n",
        ),
        ("clipped value by value", "clip_grad_norm_", "clip_grad_value_"),
        (
            "clipped before there is a gradient",
            "    optimiser.zero_grad()\n"
            "    loss.backward()\n"
            "    torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP_NORM)\n",
            "    optimiser.zero_grad()\n"
            "    torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP_NORM)\n"
            "    loss.backward()\n",
        ),
        ("sum for mean", "error**2).mean()", "error**2).sum()"),
        ("absolute error", "error**2", "error.abs()"),
        (
            "weights are normalised",
            "error**2).mean()",
            "error**2).sum() / (1.0 + TURN_WEIGHT * labels.abs()).sum()",
        ),
        ("no step", "    optimiser.step()\n", "    pass\n"),
        ("weighed by the network's own answer", "labels.abs()", "(error + labels).abs().detach()"),
    ),
    "closed_loop_eval": (
        (
            "failures count in the mean deviation",
            "np.abs(offsets[landed]).mean()",
            "np.abs(offsets).mean()",
        ),
        (
            "failures count as 0",
            "np.abs(offsets[landed]).mean()",
            "np.abs(offsets * landed).mean()",
        ),
        ("deviation with its sign", "np.abs(offsets[landed]).mean()", "offsets[landed].mean()"),
        ("lost is not asked", "not flight.lost and abs", "abs"),
        (
            "left of the line always lands",
            "abs(flight.offset) <= PAD_HALF",
            "flight.offset <= PAD_HALF",
        ),
        (
            "history is kept from flight to flight",
            "    for start in starts:\n        flight, history = begin(start), np.zeros(k)\n",
            "    history = np.zeros(k)\n    for start in starts:\n        flight = begin(start)\n",
        ),
        ("newest last", "[[aileron], history[:-1]]", "[history[1:], [aileron]]"),
        (
            "not cut",
            "float(np.clip(policy(flight.look(), history), -1.0, 1.0))",
            "float(policy(flight.look(), history))",
        ),
        ("history is never filled", "history = np.concatenate([[aileron], history[:-1]])", "pass"),
        (
            "looks once only",
            "        while not flight.over:\n            aileron = "
            "float(np.clip(policy(flight.look()",
            "        image = flight.look()\n"
            "        while not flight.over:\n"
            "            aileron = float(np.clip(policy(image",
        ),
        ("success of lost ones", "float(landed.mean())", "float(1.0 - landed.mean())"),
    ),
}
