/* Writes the values and verdicts of the features of a scene as CSV.
 *
 * usage: features SCENE
 */
#include <lasertrace.h>
#include <stdio.h>
#include <stdlib.h>

static void must(lasertrace_status status)
{
    if (status != LASERTRACE_STATUS_OK) {
        fprintf(stderr, "%s\n", lasertrace_last_error());
        exit(1);
    }
}

int main(int argc, char **argv)
{
    static const char *const verdicts[] = { "", "conforms", "does not conform", "undecided" };
    if (argc != 2) {
        fprintf(stderr, "usage: features SCENE\n");
        return 64;
    }
    lasertrace_scene *scene = NULL;
    lasertrace_simulation *simulation = NULL;
    lasertrace_features *features = NULL;
    uint64_t count;
    must(lasertrace_scene_load(argv[1], &scene));
    must(lasertrace_simulation_new(scene, 0, &simulation));
    must(lasertrace_simulation_features(simulation, &features));
    must(lasertrace_simulation_free(simulation));
    must(lasertrace_scene_free(scene));
    must(lasertrace_features_count(features, &count));
    for (uint64_t i = 0; i < count; i++) {
        lasertrace_feature_value v;
        must(lasertrace_features_value(features, i, &v));
        printf("%s,%s,%s,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%.17g,%s,%.17g,%.17g,%llu,%s,%u\n",
               v.feature, v.kind, v.quantity ? v.quantity : "", v.nominal, v.measured, v.deviation,
               v.standard_uncertainty, v.expanded_uncertainty, v.lower, v.upper,
               verdicts[v.conformance], v.u_over_t, v.smallest_tolerance,
               (unsigned long long)v.points, v.problem ? v.problem : "", v.lower_bound);
    }
    must(lasertrace_features_free(features));
    return 0;
}
