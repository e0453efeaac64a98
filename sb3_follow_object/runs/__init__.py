"""Training in a folder: started, interrupted, resumed, evaluated; the predictors that are kept."""
