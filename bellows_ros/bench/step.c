/* The integrator of core/integrator.py and core/kernels.py by hand in C, as the limit of what
   compiling the Python source can reach. Compiled by `bellows bench` alone; frames, names and
   equation numbers are those of the Python files. */

#include <math.h>

typedef struct { double x, y, z; } vec;
typedef struct { double x, y, z, w; } quat;
typedef struct { double a[9]; } mat;
typedef struct { mat oo, oR, RR; } blocks;
typedef struct {
    double l1, l0;
    blocks K, P;
    double mass;
    vec com;
    mat inertia, inertia_inverse;
    vec gravity;
} model;
typedef struct { vec o; quat q; vec v, w; } state;
typedef struct { vec o; mat R; vec v, w; } frame; /* a state with its rotation matrix */
typedef struct { vec a, b; } pair;                /* two halves of a six-vector */
typedef struct { double duration; vec o0, a1, a2, a3; quat q0; vec c1, c2, c3; } segment;

#define FN static inline

FN vec add(vec a, vec b) { return (vec){a.x + b.x, a.y + b.y, a.z + b.z}; }
FN vec sub(vec a, vec b) { return (vec){a.x - b.x, a.y - b.y, a.z - b.z}; }
FN vec scale(double k, vec a) { return (vec){k * a.x, k * a.y, k * a.z}; }
FN vec axpy(vec a, double k, vec b) { return (vec){a.x + k * b.x, a.y + k * b.y, a.z + k * b.z}; }
FN double dot(vec a, vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
FN vec cross(vec a, vec b)
{
    return (vec){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
FN vec mul(const mat *A, vec v)
{
    const double *a = A->a;
    return (vec){a[0] * v.x + a[1] * v.y + a[2] * v.z, a[3] * v.x + a[4] * v.y + a[5] * v.z,
                 a[6] * v.x + a[7] * v.y + a[8] * v.z};
}
FN vec tmul(const mat *A, vec v)
{
    const double *a = A->a;
    return (vec){a[0] * v.x + a[3] * v.y + a[6] * v.z, a[1] * v.x + a[4] * v.y + a[7] * v.z,
                 a[2] * v.x + a[5] * v.y + a[8] * v.z};
}
FN mat tmulm(const mat *A, const mat *B)
{
    mat C;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            C.a[3 * i + j] =
                A->a[i] * B->a[j] + A->a[3 + i] * B->a[3 + j] + A->a[6 + i] * B->a[6 + j];
    return C;
}
FN quat qmul(quat p, quat q)
{
    return (quat){p.w * q.x + p.x * q.w + p.y * q.z - p.z * q.y,
                  p.w * q.y - p.x * q.z + p.y * q.w + p.z * q.x,
                  p.w * q.z + p.x * q.y - p.y * q.x + p.z * q.w,
                  p.w * q.w - p.x * q.x - p.y * q.y - p.z * q.z};
}
FN mat rot(quat q)
{
    double x = q.x, y = q.y, z = q.z, w = q.w;
    return (mat){{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                  2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                  2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
}
FN quat expq(vec p)
{
    double s = dot(p, p), r, c;
    if (s < 0.25) {
        double x = 0.25 * s;
        r = 0.5 - x * (1 / 12. - x * (1 / 240. - x * (1 / 10080. - x * (1 / 725760.
            - x * (1 / 79833600.)))));
        c = 1 - x * (1 / 2. - x * (1 / 24. - x * (1 / 720. - x * (1 / 40320. - x * (1 / 3628800.
            - x * (1 / 479001600.))))));
    } else {
        double angle = sqrt(s);
        r = sin(0.5 * angle) / angle;
        c = cos(0.5 * angle);
    }
    return (quat){r * p.x, r * p.y, r * p.z, c};
}
FN vec logq(quat q)
{
    if (q.w < 0) q = (quat){-q.x, -q.y, -q.z, -q.w};
    double x = q.x * q.x + q.y * q.y + q.z * q.z, k;
    if (x < 1e-3) {
        k = 2 + x * (1 / 3. + x * (3 / 20. + x * (5 / 56. + x * (35 / 576.))));
    } else {
        double s = sqrt(x);
        k = 2 * atan2(s, q.w) / s;
    }
    return (vec){k * q.x, k * q.y, k * q.z};
}
FN vec body_rate(vec phi, vec rate) /* (G.65) */
{
    double x = dot(phi, phi), first, second;
    if (x < 0.25) {
        first = 1 / 2. - x * (1 / 24. - x * (1 / 720. - x * (1 / 40320. - x * (1 / 3628800.
            - x * (1 / 479001600.)))));
        second = 1 / 6. - x * (1 / 120. - x * (1 / 5040. - x * (1 / 362880. - x * (1 / 39916800.
            - x * (1 / 6227020800.)))));
    } else {
        double angle = sqrt(x);
        first = (1 - cos(angle)) / x;
        second = (angle - sin(angle)) / (x * angle);
    }
    vec once = cross(phi, rate);
    return axpy(axpy(rate, -first, once), second, cross(phi, once));
}
FN vec vector_rate(vec phi, vec omega)
{
    double x = dot(phi, phi), k;
    if (x < 0.25) {
        double tail = 1 / 47900160. + x * (691 / 1307674368000. + x * (1 / 74724249600.));
        k = 1 / 12. + x * (1 / 720. + x * (1 / 30240. + x * (1 / 1209600. + x * tail)));
    } else {
        double angle = sqrt(x);
        k = (1 - 0.5 * angle / tan(0.5 * angle)) / x;
    }
    vec once = cross(phi, omega);
    return axpy(axpy(omega, 0.5, once), k, cross(phi, once));
}

FN pair bmul(const blocks *M, vec a, vec b)
{
    return (pair){add(mul(&M->oo, a), mul(&M->oR, b)), add(tmul(&M->oR, a), mul(&M->RR, b))};
}

FN pair cup_wrench(const model *m, vec o_lip, const mat *R, vec v_lip, vec w)
{
    double l1 = m->l1;
    const double *r = R->a;
    vec o = {o_lip.x + l1 * r[2], o_lip.y + l1 * r[5], o_lip.z + l1 * r[8] + m->l0 - l1};
    vec v = {v_lip.x + l1 * w.y, v_lip.y - l1 * w.x, v_lip.z}; /* (3.34) */
    vec R_o = tmul(R, o);
    /* spring, (3.18), (3.27) */
    pair s = bmul(&m->K, add(o, R_o), (vec){r[7] - r[5], r[2] - r[6], r[3] - r[1]});
    vec spring_f = add(s.a, tmul(R, s.a));
    vec spring_m =
        add(sub(scale(r[0] + r[4] + r[8], s.b), mul(R, s.b)), cross(s.a, R_o));
    /* damper, (3.32), (3.33) */
    pair near = bmul(&m->P, v, w);
    vec R_w = mul(R, w);
    pair far = bmul(&m->P, add(mul(R, v), cross(o, R_w)), R_w);
    vec damper_f = add(near.a, tmul(R, far.a));
    vec damper_m = add(near.b, tmul(R, sub(far.b, cross(o, far.a))));
    vec f = add(scale(-0.25, spring_f), scale(-0.5, damper_f));
    vec n = add(scale(-0.25, spring_m), scale(-0.5, damper_m));
    return (pair){f, {n.x - l1 * f.y, n.y + l1 * f.x, n.z}}; /* (3.25) */
}

FN pair acceleration(const model *m, const frame *tool, const frame *body) /* (3.42) */
{
    mat R = tmulm(&tool->R, &body->R);
    vec o = tmul(&tool->R, sub(sub(body->o, mul(&body->R, m->com)), tool->o));
    vec v = sub(add(body->v, cross(m->com, body->w)),
                tmul(&R, add(tool->v, cross(tool->w, o))));
    vec w = sub(body->w, tmul(&R, tool->w));
    pair f = cup_wrench(m, o, &R, v, w);
    vec n = sub(f.b, cross(m->com, f.a));
    vec dv = axpy(sub(tmul(&body->R, m->gravity), cross(body->w, body->v)), 1 / m->mass, f.a);
    vec dw = mul(&m->inertia_inverse, sub(n, cross(body->w, mul(&m->inertia, body->w))));
    return (pair){dv, dw};
}

FN frame framed(const state *s) { return (frame){s->o, rot(s->q), s->v, s->w}; }

FN vec quadratic(vec step, vec a, vec b) { return axpy(axpy(scale(3, step), -2, a), -1, b); }
FN vec cubic3(vec step, vec a, vec b) { return axpy(add(a, b), -2, step); }
FN vec cubic(double s, vec a, vec b, vec c) { return scale(s, axpy(a, s, axpy(b, s, c))); }
FN vec slope(double s, vec a, vec b, vec c) { return axpy(a, 2 * s, axpy(b, 1.5 * s, c)); }

FN segment tool_segment(const state *s, const state *e, double h)
{
    mat R0 = rot(s->q), R1 = rot(e->q);
    vec a1 = scale(h, mul(&R0, s->v)), a1_end = scale(h, mul(&R1, e->v));
    vec step = sub(e->o, s->o);
    vec phi = logq(qmul((quat){-s->q.x, -s->q.y, -s->q.z, s->q.w}, e->q));
    vec c1 = scale(h, s->w), c1_end = scale(h, vector_rate(phi, e->w));
    return (segment){h, s->o, a1, quadratic(step, a1, a1_end), cubic3(step, a1, a1_end),
                     s->q, c1, quadratic(phi, c1, c1_end), cubic3(phi, c1, c1_end)};
}

FN frame tool_at(const segment *g, double s)
{
    vec phi = cubic(s, g->c1, g->c2, g->c3);
    mat R = rot(qmul(g->q0, expq(phi)));
    vec v = scale(1 / g->duration, slope(s, g->a1, g->a2, g->a3));
    vec w = scale(1 / g->duration, body_rate(phi, slope(s, g->c1, g->c2, g->c3)));
    return (frame){add(g->o0, cubic(s, g->a1, g->a2, g->a3)), R, tmul(&R, v), w};
}

FN state moved(const state *b, double h, vec o, vec s, vec v, vec w)
{
    return (state){axpy(b->o, h, o), qmul(b->q, expq(scale(h, s))), axpy(b->v, h, v),
                   axpy(b->w, h, w)};
}

FN vec rotation_rate(vec sigma, vec w)
{
    vec once = cross(sigma, w);
    return axpy(axpy(w, 0.5, once), 1 / 12., cross(sigma, once));
}

FN vec mean(vec a, vec b, vec c, vec d)
{
    return scale(1 / 6., add(add(a, d), scale(2, add(b, c))));
}

static state rkmk4(const model *m, const state *body, const frame *t0, const frame *t1,
                   const frame *t2, double h)
{
    frame f = framed(body);
    vec o1 = mul(&f.R, f.v), s1 = f.w;
    pair d1 = acceleration(m, t0, &f);
    state b = moved(body, 0.5 * h, o1, s1, d1.a, d1.b);
    f = framed(&b);
    vec o2 = mul(&f.R, f.v), s2 = rotation_rate(scale(0.5 * h, s1), f.w);
    pair d2 = acceleration(m, t1, &f);
    b = moved(body, 0.5 * h, o2, s2, d2.a, d2.b);
    f = framed(&b);
    vec o3 = mul(&f.R, f.v), s3 = rotation_rate(scale(0.5 * h, s2), f.w);
    pair d3 = acceleration(m, t1, &f);
    b = moved(body, h, o3, s3, d3.a, d3.b);
    f = framed(&b);
    vec o4 = mul(&f.R, f.v), s4 = rotation_rate(scale(h, s3), f.w);
    pair d4 = acceleration(m, t2, &f);
    b = moved(body, h, mean(o1, o2, o3, o4), mean(s1, s2, s3, s4), mean(d1.a, d2.a, d3.a, d4.a),
              mean(d1.b, d2.b, d3.b, d4.b));
    quat q = b.q;
    double k = 1.5 - 0.5 * (q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w);
    b.q = (quat){k * q.x, k * q.y, k * q.z, k * q.w};
    return b;
}

/* Write count rows of 13 numbers: the package at each of the tool's rows. */
void simulate(const model *m, const state *start, const state *tool, const double *durations,
              long count, state *out)
{
    state body = out[0] = *start;
    for (long k = 0; k + 1 < count; k++) {
        segment g = tool_segment(&tool[k], &tool[k + 1], durations[k]);
        frame begin = framed(&tool[k]), middle = tool_at(&g, 0.5), end = framed(&tool[k + 1]);
        body = rkmk4(m, &body, &begin, &middle, &end, durations[k]);
        out[k + 1] = body;
    }
}
