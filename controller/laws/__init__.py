"""Control laws: a law may clip, the supervisor never does."""
