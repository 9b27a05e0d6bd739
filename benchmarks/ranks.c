/* Counts what a rank sends, between a program and MPI (MPI's profiling interface); see ranks.py. */
#include <mpi.h>

enum { REDUCTION, BROADCAST, GATHERING, TO_ALL, MESSAGE, KINDS };
enum { KNOWN = 65536 };

/* calls of each kind, and behind them the bytes that they send */
long tfeti_sent[2 * KINDS];
/* persistent requests, and their bytes */
static struct { MPI_Request request; long bytes; } known[KNOWN];
static int last;

static long size(int n, MPI_Datatype type) { int s; PMPI_Type_size(type, &s); return (long)n * s; }
static int ranks(MPI_Comm comm) { int n; PMPI_Comm_size(comm, &n); return n; }
static long sum(const int *n, int count) { long s = 0; while (count--) s += n[count]; return s; }
static void add(int kind, long bytes) { ++tfeti_sent[kind]; tfeti_sent[KINDS + kind] += bytes; }

#define CALL(name, kind, bytes, types, names) \
    int MPI_##name types { if (ranks(c) > 1) add(kind, bytes); return PMPI_##name names; }
#define V const void *a
#define T MPI_Datatype
#define C MPI_Comm c

CALL(Allreduce, REDUCTION, size(n, t), (V, void *b, int n, T t, MPI_Op o, C), (a, b, n, t, o, c))
CALL(Reduce, REDUCTION, size(n, t), (V, void *b, int n, T t, MPI_Op o, int r, C), (a, b, n, t, o, r, c))
CALL(Scan, REDUCTION, size(n, t), (V, void *b, int n, T t, MPI_Op o, C), (a, b, n, t, o, c))
CALL(Exscan, REDUCTION, size(n, t), (V, void *b, int n, T t, MPI_Op o, C), (a, b, n, t, o, c))
CALL(Bcast, BROADCAST, size(n, t), (void *a, int n, T t, int r, C), (a, n, t, r, c))
CALL(Gather, GATHERING, size(n, t), (V, int n, T t, void *b, int m, T s, int r, C), (a, n, t, b, m, s, r, c))
CALL(Gatherv, GATHERING, size(n, t), (V, int n, T t, void *b, const int *m, const int *d, T s, int r, C),
     (a, n, t, b, m, d, s, r, c))
CALL(Allgather, GATHERING, size(n, t), (V, int n, T t, void *b, int m, T s, C), (a, n, t, b, m, s, c))
CALL(Allgatherv, GATHERING, size(n, t), (V, int n, T t, void *b, const int *m, const int *d, T s, C),
     (a, n, t, b, m, d, s, c))
CALL(Alltoall, TO_ALL, ranks(c) * size(n, t), (V, int n, T t, void *b, int m, T s, C), (a, n, t, b, m, s, c))
CALL(Alltoallv, TO_ALL, sum(n, ranks(c)) * size(1, t),
     (V, const int *n, const int *d, T t, void *b, const int *m, const int *e, T s, C),
     (a, n, d, t, b, m, e, s, c))
CALL(Send, MESSAGE, size(n, t), (V, int n, T t, int r, int tag, C), (a, n, t, r, tag, c))
CALL(Isend, MESSAGE, size(n, t), (V, int n, T t, int r, int tag, C, MPI_Request *q), (a, n, t, r, tag, c, q))
CALL(Issend, MESSAGE, size(n, t), (V, int n, T t, int r, int tag, C, MPI_Request *q), (a, n, t, r, tag, c, q))

int MPI_Send_init(V, int n, T t, int r, int tag, C, MPI_Request *q) {
    int error = PMPI_Send_init(a, n, t, r, tag, c, q);
    known[last % KNOWN].request = *q;
    known[last++ % KNOWN].bytes = ranks(c) > 1 ? size(n, t) : 0;
    return error;
}

static void started(MPI_Request request) {
    for (int k = last; k-- > 0 && k >= last - KNOWN;)
        if (known[k % KNOWN].request == request) { add(MESSAGE, known[k % KNOWN].bytes); return; }
}

int MPI_Start(MPI_Request *q) { started(*q); return PMPI_Start(q); }

int MPI_Startall(int n, MPI_Request *q) {
    for (int k = 0; k < n; ++k) started(q[k]);
    return PMPI_Startall(n, q);
}
