"""What a policy does, in numbers: runs that repeat one policy, and runs that copy another entry's.

Bytes prove nothing: permuted units or a little noise give another file. Policies are therefore
compared by their actions a in probe states, against the optimal actions a*. Half of the states are
in the training cube, half between it and the outermost face of the protocol. Their seed

    SHA-256(protocol digest, spec digest, submission id)

is unknown until every policy of the submission is fixed, so no policy can be altered in them alone.

Within a submission, in the same states of an instance:

    d(i, j) = mean |a_i − a_j|                          distance of two runs
    u(i)    = min(mean |a_i − a*|, mean |a_i − ā_i|)    room: error, or variation about the mean
    repeated if d ≤ max(FRACTION min(u(i), u(j)), FLOOR)

Between submissions the states differ, and the moments of the error over them are compared:

    M  = E[(a − a*) φᵀ],  φ = (1, √12 (s_k − ½) / w …)   bias and trend of the error, A × (1 + S)
    sketch = G vec(M)                                    a public random projection to 32 numbers

Either half of the states suffices. Constant policies, u(i) < CONSTANT, are exempt: training often
collapses to the same constant, and repeating one gains nothing.
"""
