"""Linear algebra of sparse symmetric systems: block Cholesky, multifrontal factors, patterns. Knows no graph."""
