"""Reads recordings and replays them through today's controller."""
