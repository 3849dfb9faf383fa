"""How much wood in an hour: single logs, piles, and a full bunk unloaded at a landing."""
