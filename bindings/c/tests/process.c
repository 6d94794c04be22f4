/* States of a process that must not change results: floating-point environments, a small
 * stack, many handles, rays of any size, fork. Given a scene's file. */
#define _GNU_SOURCE
#include <fenv.h>
#include <lasertrace.h>
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>
#include <unistd.h>
#ifdef __SSE2__
#include <xmmintrin.h>
#endif

static const char *path;

static void must(int right, const char *what)
{
    if (!right) {
        fprintf(stderr, "%s: %s\n", what, lasertrace_last_error());
        exit(1);
    }
}

#define R (10.0 / 3)
#define AT (1.0 / 7)

static lasertrace_caster *octahedron(uint32_t threads)
{
    /* An octahedron. Constants: the compiler rounds them, not the mode that is set. */
    static const double vertices[] = { R, AT, AT, -R, AT, AT, AT, R, AT,
                                       AT, -R, AT, AT, AT, R, AT, AT, -R };
    const uint32_t triangles[] = { 0, 2, 4, 2, 1, 4, 1, 3, 4, 3, 0, 4,
                                   2, 0, 5, 1, 2, 5, 3, 1, 5, 0, 3, 5 };
    lasertrace_caster_options options = { 0 };
    lasertrace_caster *caster = NULL;
    options.threads = threads;
    must(!lasertrace_caster_new(vertices, 6, triangles, 8, &options, &caster), "caster");
    return caster;
}

enum { RAYS = 20000 };

static void cast(lasertrace_caster *caster, lasertrace_surface_point *hits)
{
    lasertrace_ray *rays = malloc(RAYS * sizeof *rays);
    must(rays != NULL, "memory");
    for (int i = 0; i < RAYS; i++) {
        /* Whole numbers over powers of two: the same in every rounding mode. */
        const lasertrace_ray ray = { { (i % 141 - 70) / 16.0, (i / 141 - 70) / 16.0, 64 },
                                     { (i % 7 - 3) / 64.0, (i % 5 - 2) / 64.0, -1 }, 1024 };
        rays[i] = ray;
    }
    must(!lasertrace_closest_hits(caster, rays, RAYS, hits, RAYS), "hits");
    free(rays);
}

/* Rounding mode, traps and treatment of denormal numbers of this thread. */
typedef struct {
    int rounding, traps;
    unsigned denormals;
} environment;

static environment callers;

static environment current(void)
{
    environment now = { fegetround(), fegetexcept(), 0 };
#ifdef __SSE2__
    now.denormals = _mm_getcsr() & 0x8040;
#endif
    return now;
}

static void become(environment wanted)
{
    fedisableexcept(FE_ALL_EXCEPT);
    feclearexcept(FE_ALL_EXCEPT);
    must(!fesetround(wanted.rounding), "rounding mode");
#ifdef __SSE2__
    _mm_setcsr((_mm_getcsr() & ~0x8040u) | wanted.denormals);
#endif
    must(!wanted.traps || feenableexcept(wanted.traps) != -1, "traps");
}

static int same(environment a, environment b)
{
    return a.rounding == b.rounding && a.traps == b.traps && a.denormals == b.denormals;
}

static int progress(uint32_t done, uint32_t total, void *user)
{
    (void)done, (void)total;
    int *calls = user;
    *calls = *calls >= 0 && same(current(), callers) ? *calls + 1 : -1;
    return 0;
}

/* The counts of a frame, taken in this thread's environment from the scene's file on. */
static uint16_t *frame(size_t *length)
{
    lasertrace_scene *scene = NULL;
    lasertrace_simulation *simulation = NULL;
    lasertrace_size size;
    lasertrace_frames wanted = { 0 };
    int calls = 0;
    must(!lasertrace_scene_load(path, &scene), "scene");
    must(!lasertrace_scene_size(scene, &size), "size");
    must(!lasertrace_simulation_new(scene, 2, &simulation), "simulation");
    *length = (size_t)size.columns * size.rows * 2;
    wanted.images = malloc(*length * sizeof *wanted.images);
    wanted.image_length = *length;
    must(wanted.images != NULL, "memory");
    must(!lasertrace_simulation_frames(simulation, 3, 2, &wanted, progress, &calls),
         "frames");
    must(calls > 0, "the progress function is called in another environment, or never");
    must(!lasertrace_simulation_free(simulation) && !lasertrace_scene_free(scene), "free");
    return wanted.images;
}

static void environments(void)
{
    /* The first call starts threads, which inherit the environment of the thread that starts
     * them: it is not the default. */
    const int traps = FE_INVALID | FE_DIVBYZERO | FE_OVERFLOW | FE_UNDERFLOW | FE_INEXACT;
    const environment tried[] = {
        { FE_UPWARD, traps, 0 },  { FE_DOWNWARD, traps, 0 },   { FE_TOWARDZERO, traps, 0 },
        { FE_TONEAREST, 0, 0 },   { FE_TONEAREST, traps, 0 },  { FE_UPWARD, 0, 0 },
        { FE_DOWNWARD, 0, 0 },    { FE_TOWARDZERO, 0, 0 },     { FE_TONEAREST, 0, 0x8040 },
    };
    const environment standard = { FE_TONEAREST, 0, 0 };
    static lasertrace_surface_point first[RAYS], other[RAYS];
    uint16_t *counts = NULL;
    size_t length = 0;
    for (size_t i = 0; i < sizeof tried / sizeof *tried; i++) {
        become(callers = tried[i]);
        callers = current();
        lasertrace_caster *caster = octahedron(2);
        cast(caster, i ? other : first);
        must(!lasertrace_caster_free(caster), "free");
        uint16_t *now = frame(&length);
        must(same(current(), callers), "the environment is not restored");
        must(!fetestexcept(FE_ALL_EXCEPT), "exception flags are left");
        become(standard);
        must(!i || !memcmp(first, other, sizeof first), "hits depend on the environment");
        if (!counts)
            counts = now;
        else {
            must(!memcmp(counts, now, length * sizeof *now), "counts depend on the environment");
            free(now);
        }
    }
    free(counts);
}

static void *all(void *nothing)
{
    callers = current();
    static lasertrace_surface_point hits[RAYS];
    size_t length;
    lasertrace_caster *caster = octahedron(1);
    cast(caster, hits);
    must(!lasertrace_caster_free(caster), "free");
    free(frame(&length));
    return nothing;
}

static void small_stack(void)
{
    pthread_attr_t attributes;
    pthread_t thread;
    pthread_attr_init(&attributes);
    must(!pthread_attr_setstacksize(&attributes, 512 * 1024), "stack");
    must(!pthread_create(&thread, &attributes, all, NULL), "thread");
    pthread_join(thread, NULL);
    pthread_attr_destroy(&attributes);
}

static void many(void)
{
    enum { MANY = 2000 };
    static lasertrace_caster *casters[MANY];
    int made = 0;
    const double vertices[] = { 0, 0, 0, 1, 0, 0, 0, 1, 0 };
    const uint32_t triangle[] = { 0, 1, 2 };
    const lasertrace_caster_options options = { 0, 1, NULL, 0 };
    for (; made < MANY; made++) {
        const lasertrace_status status =
            lasertrace_caster_new(vertices, 3, triangle, 1, &options, casters + made);
        /* A machine may not grant as many threads, of which each has one. */
        if (status == LASERTRACE_STATUS_RESOURCES && strstr(lasertrace_last_error(), "threads")) {
            fprintf(stderr, "NOT TESTED beyond %d casters: no more threads\n", made);
            break;
        }
        must(status == LASERTRACE_STATUS_OK, "one of many casters");
    }
    while (made--)
        must(!lasertrace_caster_free(casters[made]), "free");
}

/* A number from 0 to 1. */
static double drawn(void)
{
    static uint64_t state = 43;
    state = state * 6364136223846793005u + 1442695040888963407u;
    return (double)(state >> 11) / 9007199254740992.0;
}

/* Of any size that a double has, and either sign. */
static double any_size(void)
{
    const double size = drawn() < 0.2 ? 0 : pow(10, 623 * drawn() - 323);
    return drawn() < 0.5 ? -size : size;
}

/* Packets of 16 rays from one origin, many almost along an axis: traced or refused. */
static void rays_of_any_size(void)
{
    lasertrace_caster *caster = octahedron(1);
    for (int packet = 0; packet < 5000; packet++) {
        lasertrace_ray rays[16];
        lasertrace_surface_point hits[16];
        uint8_t any[16];
        const double origin[3] = { 600 * drawn() - 300, 600 * drawn() - 300, 600 * drawn() - 300 };
        const int axis = (int)(3 * drawn()), aligned = drawn() < 0.7;
        for (int i = 0; i < 16; i++) {
            for (int k = 0; k < 3; k++) {
                rays[i].origin[k] = origin[k];
                rays[i].direction[k] = aligned ? any_size() * 1e-300 : any_size();
            }
            if (aligned)
                rays[i].direction[axis] = drawn() < 0.5 ? -1 : 1;
            rays[i].t_max = drawn() < 0.5 ? INFINITY : fabs(any_size());
        }
        const lasertrace_status status = lasertrace_closest_hits(caster, rays, 16, hits, 16);
        must(status == LASERTRACE_STATUS_OK
                 || (status == LASERTRACE_STATUS_ARGUMENT
                     && strstr(lasertrace_last_error(), ": direction")),
             "rays of any size");
        must(lasertrace_any_hits(caster, rays, 16, any, 16) == status, "any hits");
        must(!lasertrace_nearest_points(caster, origin, 1, hits, 1), "nearest");
        must(hits[0].distance >= 0, "a distance");
    }
    must(!lasertrace_caster_free(caster), "free");
}

static int child_status(pid_t child)
{
    int status = -1;
    return waitpid(child, &status, 0) == child ? status : -1;
}

/* A child made before the first call. */
static void forked_early(void)
{
    static lasertrace_surface_point hits[RAYS];
    const pid_t child = fork();
    must(child >= 0, "fork");
    if (child == 0) {
        alarm(60);
        lasertrace_caster *caster = octahedron(2);
        cast(caster, hits);
        _exit(lasertrace_caster_free(caster) == LASERTRACE_STATUS_OK ? 0 : 1);
    }
    must(child_status(child) == 0, "a child by fork before the first call");
}

static void forked(void)
{
    static lasertrace_surface_point hits[RAYS];
    lasertrace_caster *caster = octahedron(2), *second = NULL;
    cast(caster, hits);
    const pid_t child = fork();
    must(child >= 0, "fork");
    if (child == 0) {
        /* A child that waits for threads of its parent is ended, which is an error. */
        alarm(60);
        const lasertrace_ray ray = { { 0, 0, 9 }, { 0, 0, -1 }, 99 };
        const double vertices[] = { 0, 0, 0, 1, 0, 0, 0, 1, 0 };
        const uint32_t triangle[] = { 0, 1, 2 };
        const lasertrace_status refused = LASERTRACE_STATUS_RESOURCES;
        const int right = lasertrace_closest_hits(caster, &ray, 1, hits, 1) == refused
            && strstr(lasertrace_last_error(), "fork")
            && lasertrace_caster_new(vertices, 3, triangle, 1, NULL, &second) == refused
            && lasertrace_caster_free(caster) == refused;
        _exit(right ? 0 : 1);
    }
    must(child_status(child) == 0, "a child by fork");
    must(!lasertrace_caster_free(caster), "free");
}

int main(int argc, char **argv)
{
    if (argc != 2)
        return 64;
    path = argv[1];
    forked_early();
    environments();
    small_stack();
    many();
    rays_of_any_size();
    forked();
    return 0;
}
