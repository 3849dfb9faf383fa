"""The perception of papers A and B, implemented faithfully for comparison."""
