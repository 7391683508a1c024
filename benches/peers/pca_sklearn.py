"""Full PCA of examples (rows) by scikit-learn: prints the least time of seven in ms.

    python pca_sklearn.py VECTORS.f64 EXAMPLES
"""
import sys
import time

import numpy as np
from sklearn.decomposition import PCA

vectors = np.fromfile(sys.argv[1], dtype="<f8").reshape(int(sys.argv[2]), -1)
times = []
for _ in range(7):
    start = time.perf_counter()
    PCA(svd_solver="full").fit(vectors)
    times.append(1e3 * (time.perf_counter() - start))
print(min(times))
