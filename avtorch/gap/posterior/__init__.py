"""The posterior of a fitted model: its density, draws by SGLD, summaries."""
