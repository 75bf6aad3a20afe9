"""One engine: a model of the car, its recorder and its noise, and the evidence of every set of effects.

    y_c(t) = F_c D_c h_c[x(theta, M, t)] + n_c(t)

A plant with every effect at once runs in output error (`compiled_plant`); channels c are the measured acceleration and
the differenced speed (`drive_data`). D_c and F_c are a delay and a filter of the recorder, nuisance in every hypothesis
(`recorder`). Drives are compared in lapped coefficients, nearly independent and local in time and frequency. The
noise's covariance is free in each band and integrated out (`likelihood`); sets of effects M are fitted
(`gauss_newton`), valued (`evidence`), searched (`search`) and averaged (`average`). Random parts of the same evidence:
`slow_forces`, `outliers`, `lost_messages`, `gear_shifts`; what no name explains: `force_map`, `free_forms`,
`shape_error`. Constants: `priors`.
"""
