"""Layer 1: linear algebra of sparse symmetric systems: block Cholesky, multifrontal factors, sparsity patterns."""
