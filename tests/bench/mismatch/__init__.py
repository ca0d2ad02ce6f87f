"""How soon a fault is found in a flying aircraft, and what that is worth to its predictions."""

import fleet  # noqa: F401  limits the threads of BLAS before numpy is imported
