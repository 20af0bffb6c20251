"""Meta-World: experts, demonstrations, labels, the shipped sets and policies."""
