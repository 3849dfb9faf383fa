"""The activity manager: transition tables, world model, route and crane execution, load bookkeeping, checkpoints."""
