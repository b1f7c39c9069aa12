/* A bellows suction cup and the package it holds: C99 or C++17, no allocation, libm alone.

   Written by bellows export --to c. The numbers are at the end, in `NAME` and `NAME_grip`, with
   the NAME of option --name: a program may include one header for each cup. SI units. World A
   with gravity as a vector; E tip of the tool, z into the arm; S middle of the lip; B centre of
   mass of the package, with the axes of S. Equation numbers are those of docs/model.md. Where the
   cup relaxes, BELLOWS_RELAXATION is defined, and z of the package's state are its internal
   strains, which bellows_equilibrium sets. BELLOWS_STRETCH is defined for a cup with cup.stretch.

   bellows_step           the package a time later, the tool moving from one state to another
   bellows_equilibrium    where it hangs at rest; 0, or 1 where the cup cannot carry it
   bellows_lip_wrench     of the cup on the package, at S in axes of S
   bellows_safety_factor  of the grip, the smallest of peel and slip of its cups; below 1 it lets
                          go

   All are bit for bit what bellows_ros computes where multiplications and additions are not
   contracted: gcc -ffp-contract=off. */

#ifndef BELLOWS_CUP_H
#define BELLOWS_CUP_H

#include <math.h>

#define BW static inline
#ifdef __cplusplus
#define BW_OF(type) type
#else
#define BW_OF(type) (type)
#endif

typedef struct { double x, y, z; } bw_vec;
typedef struct { double x, y, z, w; } bw_quat;
typedef struct { double a[9]; } bw_mat;
typedef struct { bw_mat oo, oR, RR; } bw_blocks;
typedef struct { bw_vec a, b; } bw_pair; /* two halves of a six-vector */
typedef struct { double r, tau; } bw_branch; /* strength as a fraction of K, time (s) */
#ifdef BELLOWS_RELAXATION
#define BW_RELAXES 1
#define BW_WITH(code) code
#define BW_NO_STRAIN , {{{0, 0, 0}, {0, 0, 0}}, {{0, 0, 0}, {0, 0, 0}}}
#define BW_STRAINS(state) (state)->z
#else
#define BW_RELAXES 0
#define BW_WITH(code)
#define BW_NO_STRAIN
#define BW_STRAINS(state) 0
#endif
#ifdef BELLOWS_STRETCH
#define BW_STRETCHES 1
#define BW_STRETCH(code) code
#else
#define BW_STRETCHES 0
#define BW_STRETCH(code)
#endif
/* Lengths in m; K and P by 3x3 blocks. */
typedef struct { double a, b; } bw_stretch; /* energy a h_z^3 + b h_z (h_rx^2 + h_ry^2), N/m^2, N */
typedef struct {
    double l1, l0;
    bw_blocks K, P;
    BW_WITH(bw_branch b1; bw_branch b2;)
    BW_STRETCH(bw_stretch stretch;)
} bellows_cup;
typedef struct { double mass; bw_vec com; bw_mat inertia, inertia_inverse; } bellows_package;
typedef struct { bellows_cup cup; bellows_package package; bw_vec gravity; } bellows_model;
/* Of each cup, N, m, 1; of a gripper of several also one of them, and where they are in E (m). */
typedef struct {
    double suction, radius, friction;
    int cups;
    const bellows_cup *one;
    const bw_vec *places;
} bellows_grip;
/* Of a frame in the world: position (m), quaternion x, y, z, w, linear and angular twist (m/s,
   rad/s) in its own axes. */
typedef struct { bw_vec o; bw_quat q; bw_vec v, w; BW_WITH(bw_pair z[2];) } bellows_state;
typedef struct { bw_vec f, m; } bellows_wrench; /* N, N m */

typedef struct { bw_vec o; bw_mat R; bw_vec v, w; } bw_frame; /* a state with a matrix */
typedef struct {
    double duration;
    bw_vec o0, a1, a2, a3;
    bw_quat q0;
    bw_vec c1, c2, c3;
} bw_segment;

BW bw_vec bw_add(bw_vec a, bw_vec b) { return BW_OF(bw_vec){a.x + b.x, a.y + b.y, a.z + b.z}; }
BW bw_vec bw_sub(bw_vec a, bw_vec b) { return BW_OF(bw_vec){a.x - b.x, a.y - b.y, a.z - b.z}; }
BW bw_vec bw_scale(double k, bw_vec a) { return BW_OF(bw_vec){k * a.x, k * a.y, k * a.z}; }
BW bw_vec bw_axpy(bw_vec a, double k, bw_vec b)
{
    return BW_OF(bw_vec){a.x + k * b.x, a.y + k * b.y, a.z + k * b.z};
}
BW double bw_dot(bw_vec a, bw_vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
BW bw_vec bw_cross(bw_vec a, bw_vec b)
{
    return BW_OF(bw_vec){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
BW bw_vec bw_mul(const bw_mat *A, bw_vec v)
{
    const double *a = A->a;
    return BW_OF(bw_vec){a[0] * v.x + a[1] * v.y + a[2] * v.z,
        a[3] * v.x + a[4] * v.y + a[5] * v.z,
        a[6] * v.x + a[7] * v.y + a[8] * v.z};
}
BW bw_vec bw_tmul(const bw_mat *A, bw_vec v)
{
    const double *a = A->a;
    return BW_OF(bw_vec){a[0] * v.x + a[3] * v.y + a[6] * v.z,
        a[1] * v.x + a[4] * v.y + a[7] * v.z,
        a[2] * v.x + a[5] * v.y + a[8] * v.z};
}
BW bw_mat bw_tmulm(const bw_mat *A, const bw_mat *B)
{
    bw_mat C;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            C.a[3 * i + j] =
                A->a[i] * B->a[j] + A->a[3 + i] * B->a[3 + j] + A->a[6 + i] * B->a[6 + j];
    return C;
}
BW bw_quat bw_qmul(bw_quat p, bw_quat q)
{
    return BW_OF(bw_quat){p.w * q.x + p.x * q.w + p.y * q.z - p.z * q.y,
        p.w * q.y - p.x * q.z + p.y * q.w + p.z * q.x,
        p.w * q.z + p.x * q.y - p.y * q.x + p.z * q.w,
        p.w * q.w - p.x * q.x - p.y * q.y - p.z * q.z};
}
BW bw_mat bw_rot(bw_quat q)
{
    double x = q.x, y = q.y, z = q.z, w = q.w;
    return BW_OF(bw_mat){{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
}
BW bw_quat bw_expq(bw_vec p)
{
    double s = bw_dot(p, p), r, c;
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
    return BW_OF(bw_quat){r * p.x, r * p.y, r * p.z, c};
}
BW bw_vec bw_logq(bw_quat q)
{
    if (q.w < 0) q = BW_OF(bw_quat){-q.x, -q.y, -q.z, -q.w};
    double x = q.x * q.x + q.y * q.y + q.z * q.z, k;
    if (x < 1e-3) {
        k = 2 + x * (1 / 3. + x * (3 / 20. + x * (5 / 56. + x * (35 / 576.))));
    } else {
        double s = sqrt(x);
        k = 2 * atan2(s, q.w) / s;
    }
    return BW_OF(bw_vec){k * q.x, k * q.y, k * q.z};
}
BW bw_vec bw_body_rate(bw_vec phi, bw_vec rate) /* (G.65) */
{
    double x = bw_dot(phi, phi), first, second;
    if (x < 0.25) {
        first = 1 / 2. - x * (1 / 24. - x * (1 / 720. - x * (1 / 40320. - x * (1 / 3628800.
            - x * (1 / 479001600. - x / 87178291200.)))));
        second = 1 / 6. - x * (1 / 120. - x * (1 / 5040. - x * (1 / 362880. - x * (1 / 39916800.
            - x * (1 / 6227020800. - x / 1307674368000.)))));
    } else {
        double angle = sqrt(x);
        first = (1 - cos(angle)) / x;
        second = (angle - sin(angle)) / (x * angle);
    }
    bw_vec once = bw_cross(phi, rate);
    return bw_axpy(bw_axpy(rate, -first, once), second, bw_cross(phi, once));
}
BW bw_vec bw_vector_rate(bw_vec phi, bw_vec omega)
{
    double x = bw_dot(phi, phi), k;
    if (x < 0.25) {
        double tail = 1 / 47900160. + x * (691 / 1307674368000. + x * (1 / 74724249600.));
        k = 1 / 12. + x * (1 / 720. + x * (1 / 30240. + x * (1 / 1209600. + x * tail)));
    } else {
        double angle = sqrt(x);
        k = (1 - 0.5 * angle / tan(0.5 * angle)) / x;
    }
    bw_vec once = bw_cross(phi, omega);
    return bw_axpy(bw_axpy(omega, 0.5, once), k, bw_cross(phi, once));
}

BW bw_pair bw_bmul(const bw_blocks *M, bw_vec a, bw_vec b)
{
    return BW_OF(bw_pair){bw_add(bw_mul(&M->oo, a), bw_mul(&M->oR, b)),
        bw_add(bw_tmul(&M->oR, a), bw_mul(&M->RR, b))};
}

#ifdef BELLOWS_RELAXATION
BW bw_vec bw_effective(const bellows_cup *c, bw_vec h, bw_vec y, bw_vec z)
{
    double r = c->b1.r, s = c->b2.r;
    return bw_axpy(bw_axpy(bw_scale(1 + r + s, h), -r, y), -s, z);
}
BW bw_pair bw_strain_rate(bw_branch b, const bw_pair *h, const bw_pair *z)
{
    return BW_OF(bw_pair){bw_scale(1 / b.tau, bw_sub(h->a, z->a)),
        bw_scale(1 / b.tau, bw_sub(h->b, z->b))};
}
#endif

/* For internal strains z, whose rates are written to dz; where z is 0, those of long rest are. */
BW bw_pair bw_cup_wrench(
    const bellows_cup *c, bw_vec o_lip, const bw_mat *R, bw_vec v_lip, bw_vec w,
    const bw_pair *z, bw_pair *dz)
{
    double l1 = c->l1;
    const double *r = R->a;
    bw_vec o = {o_lip.x + l1 * r[2], o_lip.y + l1 * r[5], o_lip.z + l1 * r[8] + (c->l0 - l1)};
    bw_vec v = {v_lip.x + l1 * w.y, v_lip.y - l1 * w.x, v_lip.z}; /* (3.34) */
    bw_vec R_o = bw_tmul(R, o);
    /* spring, (3.18), (3.27) */
    bw_vec skew = {r[7] - r[5], r[2] - r[6], r[3] - r[1]};
    bw_pair h = {bw_add(o, R_o), skew};
#ifdef BELLOWS_STRETCH
    bw_pair pure = h;
#endif
#ifdef BELLOWS_RELAXATION
    if (dz) {
        dz[0] = z ? bw_strain_rate(c->b1, &h, &z[0]) : h;
        dz[1] = z ? bw_strain_rate(c->b2, &h, &z[1]) : h;
    }
    if (z) {
        h.a = bw_effective(c, h.a, z[0].a, z[1].a);
        h.b = bw_effective(c, h.b, z[0].b, z[1].b);
    }
#else
    (void)z;
    (void)dz;
#endif
    bw_pair s = bw_bmul(&c->K, h.a, h.b);
#ifdef BELLOWS_STRETCH
    double ka = c->stretch.a, kb = c->stretch.b, hz = pure.a.z, hx = pure.b.x, hy = pure.b.y;
    double bending = 8 * kb * hz;
    s.a.z = s.a.z + 12 * ka * hz * hz + 4 * kb * (hx * hx + hy * hy);
    s.b.x = s.b.x + bending * hx;
    s.b.y = s.b.y + bending * hy;
#endif
    bw_vec spring_f = bw_add(s.a, bw_tmul(R, s.a));
    bw_vec spring_m =
        bw_add(bw_sub(bw_scale(r[0] + r[4] + r[8], s.b), bw_mul(R, s.b)), bw_cross(s.a, R_o));
    /* damper, (3.32), (3.33) */
    bw_pair near = bw_bmul(&c->P, v, w);
    bw_vec R_w = bw_mul(R, w);
    bw_pair far = bw_bmul(&c->P, bw_add(bw_mul(R, v), bw_cross(o, R_w)), R_w);
    bw_vec damper_f = bw_add(near.a, bw_tmul(R, far.a));
    bw_vec damper_m = bw_add(near.b, bw_tmul(R, bw_sub(far.b, bw_cross(o, far.a))));
    bw_vec f = bw_add(bw_scale(-0.25, spring_f), bw_scale(-0.5, damper_f));
    bw_vec n = bw_add(bw_scale(-0.25, spring_m), bw_scale(-0.5, damper_m));
    return BW_OF(bw_pair){f, {n.x - l1 * f.y, n.y + l1 * f.x, n.z}}; /* (3.25) */
}

BW bw_frame bw_lip(bw_vec com, const bw_frame *tool, const bw_frame *body) /* S in E */
{
    bw_mat R = bw_tmulm(&tool->R, &body->R);
    bw_vec o = bw_tmul(&tool->R, bw_sub(bw_sub(body->o, bw_mul(&body->R, com)), tool->o));
    bw_vec v = bw_sub(bw_add(body->v, bw_cross(com, body->w)),
                      bw_tmul(&R, bw_add(tool->v, bw_cross(tool->w, o))));
    return BW_OF(bw_frame){o, R, v, bw_sub(body->w, bw_tmul(&R, tool->w))};
}

BW bellows_wrench bw_lip_wrench(
    const bellows_model *m, const bw_frame *tool, const bw_frame *body, const bw_pair *z,
    bw_pair *dz)
{
    bw_frame s = bw_lip(m->package.com, tool, body);
    bw_pair f = bw_cup_wrench(&m->cup, s.o, &s.R, s.v, s.w, z, dz);
    return BW_OF(bellows_wrench){f.a, f.b};
}

BW bw_pair bw_acceleration(
    const bellows_model *m, const bw_frame *tool, const bw_frame *body, const bw_pair *z,
    bw_pair *dz) /* (3.42) */
{
    const bellows_package *p = &m->package;
    bellows_wrench f = bw_lip_wrench(m, tool, body, z, dz);
    bw_vec n = bw_sub(f.m, bw_cross(p->com, f.f));
    bw_vec fall = bw_sub(bw_tmul(&body->R, m->gravity), bw_cross(body->w, body->v));
    bw_vec turn = bw_sub(n, bw_cross(body->w, bw_mul(&p->inertia, body->w)));
    return BW_OF(bw_pair){bw_axpy(fall, 1 / p->mass, f.f), bw_mul(&p->inertia_inverse, turn)};
}

BW bw_frame bw_framed(const bellows_state *s)
{
    return BW_OF(bw_frame){s->o, bw_rot(s->q), s->v, s->w};
}

BW bw_vec bw_quadratic(bw_vec step, bw_vec a, bw_vec b)
{
    return bw_axpy(bw_axpy(bw_scale(3, step), -2, a), -1, b);
}
BW bw_vec bw_cubic3(bw_vec step, bw_vec a, bw_vec b)
{
    return bw_axpy(bw_add(a, b), -2, step);
}
BW bw_vec bw_cubic(double s, bw_vec a, bw_vec b, bw_vec c)
{
    return bw_scale(s, bw_axpy(a, s, bw_axpy(b, s, c)));
}
BW bw_vec bw_slope(double s, bw_vec a, bw_vec b, bw_vec c)
{
    return bw_axpy(a, 2 * s, bw_axpy(b, 1.5 * s, c));
}

BW bw_segment bw_tool_segment(const bellows_state *s, const bellows_state *e, double h)
{
    bw_mat R0 = bw_rot(s->q), R1 = bw_rot(e->q);
    bw_vec a1 = bw_scale(h, bw_mul(&R0, s->v)), a1_end = bw_scale(h, bw_mul(&R1, e->v));
    bw_vec step = bw_sub(e->o, s->o);
    bw_vec phi = bw_logq(bw_qmul(BW_OF(bw_quat){-s->q.x, -s->q.y, -s->q.z, s->q.w}, e->q));
    bw_vec c1 = bw_scale(h, s->w), c1_end = bw_scale(h, bw_vector_rate(phi, e->w));
    return BW_OF(bw_segment){h, s->o, a1, bw_quadratic(step, a1, a1_end),
        bw_cubic3(step, a1, a1_end),
        s->q, c1, bw_quadratic(phi, c1, c1_end), bw_cubic3(phi, c1, c1_end)};
}

BW bw_frame bw_tool_at(const bw_segment *g, double s)
{
    bw_vec phi = bw_cubic(s, g->c1, g->c2, g->c3);
    bw_mat R = bw_rot(bw_qmul(g->q0, bw_expq(phi)));
    bw_vec v = bw_scale(1 / g->duration, bw_slope(s, g->a1, g->a2, g->a3));
    bw_vec w = bw_scale(1 / g->duration, bw_body_rate(phi, bw_slope(s, g->c1, g->c2, g->c3)));
    return BW_OF(bw_frame){bw_add(g->o0, bw_cubic(s, g->a1, g->a2, g->a3)), R, bw_tmul(&R, v), w};
}

BW bellows_state bw_moved(
    const bellows_state *b, double h, bw_vec o, bw_vec s, bw_vec v, bw_vec w, const bw_pair *dz)
{
    bellows_state to = {bw_axpy(b->o, h, o), bw_qmul(b->q, bw_expq(bw_scale(h, s))),
        bw_axpy(b->v, h, v), bw_axpy(b->w, h, w) BW_NO_STRAIN};
#ifdef BELLOWS_RELAXATION
    for (int i = 0; i < 2; i++)
        to.z[i] = BW_OF(bw_pair){
            bw_axpy(b->z[i].a, h, dz[i].a), bw_axpy(b->z[i].b, h, dz[i].b)};
#else
    (void)dz;
#endif
    return to;
}

BW bw_vec bw_rotation_rate(bw_vec sigma, bw_vec w)
{
    bw_vec once = bw_cross(sigma, w);
    return bw_axpy(bw_axpy(w, 0.5, once), 1 / 12., bw_cross(sigma, once));
}

BW bw_vec bw_mean(bw_vec a, bw_vec b, bw_vec c, bw_vec d)
{
    return bw_scale(1 / 6., bw_add(bw_add(a, d), bw_scale(2, bw_add(b, c))));
}

BW bw_quat bw_renormalised(bw_quat q)
{
    double k = 1.5 - 0.5 * (q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w);
    return BW_OF(bw_quat){k * q.x, k * q.y, k * q.z, k * q.w};
}

BW bellows_state bw_rkmk4(
    const bellows_model *m, const bellows_state *body, const bw_frame *t0, const bw_frame *t1,
    const bw_frame *t2, double h)
{
    bw_pair z1[2], z2[2], z3[2], z4[2];
    bw_frame f = bw_framed(body);
    bw_vec o1 = bw_mul(&f.R, f.v), s1 = f.w;
    bw_pair d1 = bw_acceleration(m, t0, &f, BW_STRAINS(body), z1);
    bellows_state b = bw_moved(body, 0.5 * h, o1, s1, d1.a, d1.b, z1);
    f = bw_framed(&b);
    bw_vec o2 = bw_mul(&f.R, f.v), s2 = bw_rotation_rate(bw_scale(0.5 * h, s1), f.w);
    bw_pair d2 = bw_acceleration(m, t1, &f, BW_STRAINS(&b), z2);
    b = bw_moved(body, 0.5 * h, o2, s2, d2.a, d2.b, z2);
    f = bw_framed(&b);
    bw_vec o3 = bw_mul(&f.R, f.v), s3 = bw_rotation_rate(bw_scale(0.5 * h, s2), f.w);
    bw_pair d3 = bw_acceleration(m, t1, &f, BW_STRAINS(&b), z3);
    b = bw_moved(body, h, o3, s3, d3.a, d3.b, z3);
    f = bw_framed(&b);
    bw_vec o4 = bw_mul(&f.R, f.v), s4 = bw_rotation_rate(bw_scale(h, s3), f.w);
    bw_pair d4 = bw_acceleration(m, t2, &f, BW_STRAINS(&b), z4);
#ifdef BELLOWS_RELAXATION
    for (int i = 0; i < 2; i++)
        z1[i] = BW_OF(bw_pair){bw_mean(z1[i].a, z2[i].a, z3[i].a, z4[i].a),
            bw_mean(z1[i].b, z2[i].b, z3[i].b, z4[i].b)};
#endif
    b = bw_moved(body, h, bw_mean(o1, o2, o3, o4), bw_mean(s1, s2, s3, s4),
                 bw_mean(d1.a, d2.a, d3.a, d4.a), bw_mean(d1.b, d2.b, d3.b, d4.b), z1);
    b.q = bw_renormalised(b.q);
    return b;
}

/* Return the package's state a duration (s) later, in so many steps of integration. */
BW bellows_state bellows_step(
    const bellows_model *m, const bellows_state *body, const bellows_state *tool,
    const bellows_state *tool_end, double duration, int steps)
{
    bw_segment g = bw_tool_segment(tool, tool_end, duration);
    bw_frame begin = bw_framed(tool), last = bw_framed(tool_end);
    bellows_state now = *body;
    for (int i = 0; i < steps; i++) {
        bw_frame middle = bw_tool_at(&g, (i + 0.5) / steps);
        bw_frame end = i == steps - 1 ? last : bw_tool_at(&g, (i + 1.0) / steps);
        now = bw_rkmk4(m, &now, &begin, &middle, &end, duration / steps);
        begin = end;
    }
    return now;
}

BW bellows_wrench bellows_lip_wrench(
    const bellows_model *m, const bellows_state *tool, const bellows_state *body)
{
    bw_frame t = bw_framed(tool), b = bw_framed(body);
    return bw_lip_wrench(m, &t, &b, BW_STRAINS(body), 0);
}

BW double bw_ratio(double suction, double load)
{
    return load > 0 ? suction / load : HUGE_VAL;
}

BW double bw_factor(const bellows_grip *g, bellows_wrench w)
{
    double twist = w.m.z / g->radius;
    double peel = bw_ratio(
        g->suction, w.f.z + 2 * sqrt(w.m.x * w.m.x + w.m.y * w.m.y) / g->radius);
    double slip = bw_ratio(
        g->friction * g->suction,
        sqrt(w.f.x * w.f.x + w.f.y * w.f.y + twist * twist) + g->friction * w.f.z);
    return peel < slip ? peel : slip;
}

/* Of one cup of a gripper at its own lip, for the lip S in E and internal strains of the gripper. */
BW bellows_wrench bw_wrench_at(
    const bellows_cup *one, bw_vec a, const bw_frame *s, const bw_pair *z)
{
    bw_vec o = bw_add(s->o, bw_sub(bw_mul(&s->R, a), a));
    bw_vec v = bw_add(s->v, bw_cross(s->w, a));
#ifdef BELLOWS_RELAXATION
    bw_pair own[2] = {{bw_sub(z[0].a, bw_cross(a, z[0].b)), z[0].b},
                      {bw_sub(z[1].a, bw_cross(a, z[1].b)), z[1].b}};
    bw_pair f = bw_cup_wrench(one, o, &s->R, v, s->w, own, 0);
#else
    bw_pair f = bw_cup_wrench(one, o, &s->R, v, s->w, z, 0);
#endif
    return BW_OF(bellows_wrench){f.a, f.b};
}

BW double bellows_safety_factor(
    const bellows_model *m, const bellows_grip *g, const bellows_state *tool,
    const bellows_state *body)
{
    if (g->cups == 0)
        return bw_factor(g, bellows_lip_wrench(m, tool, body));
    bw_frame t = bw_framed(tool), b = bw_framed(body), s = bw_lip(m->package.com, &t, &b);
    double least = HUGE_VAL;
    for (int k = 0; k < g->cups; k++) {
        double own = bw_factor(g, bw_wrench_at(g->one, g->places[k], &s, BW_STRAINS(body)));
        least = own < least ? own : least;
    }
    return least;
}

/* Write M times the acceleration of the package at rest under a tool at rest in the origin. */
BW void bw_unbalance(const bellows_model *m, const bellows_state *body, double out[6])
{
    bellows_state origin = {{0, 0, 0}, {0, 0, 0, 1}, {0, 0, 0}, {0, 0, 0} BW_NO_STRAIN};
    bw_frame t = bw_framed(&origin), b = bw_framed(body);
    bw_pair a = bw_acceleration(m, &t, &b, 0, 0);
    bw_vec f = bw_scale(m->package.mass, a.a), n = bw_mul(&m->package.inertia, a.b);
    out[0] = f.x; out[1] = f.y; out[2] = f.z; out[3] = n.x; out[4] = n.y; out[5] = n.z;
}

BW bellows_state bw_displaced(const bellows_state *b, const double by[6])
{
    bw_mat R = bw_rot(b->q);
    bw_vec shift = bw_mul(&R, BW_OF(bw_vec){by[0], by[1], by[2]});
    bw_quat q = bw_qmul(b->q, bw_expq(BW_OF(bw_vec){by[3], by[4], by[5]}));
    return BW_OF(bellows_state){bw_add(b->o, shift), q, {0, 0, 0}, {0, 0, 0} BW_NO_STRAIN};
}

/* Move the body to where nothing accelerates. Return 0, 1 at no minimum, 2 where there is none. */
BW int bw_newton(const bellows_model *m, bellows_state *body)
{
    double size = HUGE_VAL, before, A[6][6], x[6];
    int stable = 0;
    for (int turn = 0; turn < 50; turn++) {
        for (int j = 0; j < 6; j++) {
            double by[6] = {0, 0, 0, 0, 0, 0}, up[6], down[6];
            bellows_state moved;
            by[j] = 1e-6;
            moved = bw_displaced(body, by);
            bw_unbalance(m, &moved, up);
            by[j] = -1e-6;
            moved = bw_displaced(body, by);
            bw_unbalance(m, &moved, down);
            for (int i = 0; i < 6; i++) A[i][j] = (down[i] - up[i]) / 2e-6;
        }
        bw_unbalance(m, body, x);
        stable = 1; /* at rest A is the Hessian of the energy: positive pivots, a minimum */
        for (int k = 0; k < 6; k++) {
            if (A[k][k] == 0) return 2;
            stable = stable && A[k][k] > 0;
            for (int i = k + 1; i < 6; i++) {
                double c = A[i][k] / A[k][k];
                for (int j = k; j < 6; j++) A[i][j] -= c * A[k][j];
                x[i] -= c * x[k];
            }
        }
        before = size;
        size = 0;
        for (int k = 5; k >= 0; k--) {
            for (int j = k + 1; j < 6; j++) x[k] -= A[k][j] * x[j];
            x[k] /= A[k][k];
            size += x[k] * x[k];
        }
        size = sqrt(size);
        if (!(size < HUGE_VAL)) return 2;
        for (int k = 0; k < 6; k++) x[k] *= size > 0.3 ? 0.3 / size : 1;
        *body = bw_displaced(body, x);
        if ((size < 1e-9 && size > 0.1 * before) || size < 1e-13) break;
    }
    return size < 1e-9 ? !stable : 2;
}

/* Newton's method in axes of the tool, the load put on in eight steps as a real cup follows. */
BW int bellows_equilibrium(
    const bellows_model *m, const bellows_state *tool, bellows_state *body)
{
    bellows_model loaded = *m;
    bw_mat R = bw_rot(tool->q);
    bw_vec gravity = bw_tmul(&R, m->gravity), com = m->package.com;
    bellows_state now = {
        {com.x, com.y, com.z - m->cup.l0}, {0, 0, 0, 1}, {0, 0, 0}, {0, 0, 0} BW_NO_STRAIN};
    for (int load = 1; load <= 8; load++) {
        loaded.gravity = bw_scale(load / 8.0, gravity);
        int failed = bw_newton(&loaded, &now);
        if (failed == 2 || (failed && load == 8)) return 1;
    }
    now.o = bw_add(tool->o, bw_mul(&R, now.o));
    now.q = bw_qmul(tool->q, now.q);
#ifdef BELLOWS_RELAXATION
    bw_frame t = bw_framed(tool), b = bw_framed(&now);
    t.v = t.w = now.v;
    bw_lip_wrench(m, &t, &b, 0, now.z);
#endif
    *body = now;
    return 0;
}

#undef BW

#endif

#ifndef $guard
#define $guard

#if BW_RELAXES != $relaxes
#error "Either all cups of a program relax, or none: set cup.relaxation of all."
#endif
#if BW_STRETCHES != $stretches
#error "Either all cups of a program have cup.stretch, or none: set it for all."
#endif
$numbers

#endif
