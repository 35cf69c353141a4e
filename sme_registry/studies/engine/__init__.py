"""Running a study: cells, the ledger of their results, and executors."""
